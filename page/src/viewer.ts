/** The photo that is opened: the sphere, what is drawn over it, and the ways to other photos. */
import { h } from "./dom";
import { FOV, type Mode, type Model } from "./model";
import { type Depth, inCamera, samplesAround } from "./measure";
import { imagesOf } from "./pictures";
import { labelOf } from "./plan_painter";
import { Ruler } from "./ruler";
import { Sphere } from "./sphere";
import { plain, text } from "./text";
import type { Photo, Pose, Vector } from "./types";

const MODES: Mode[] = ["photo", "blend", "split", "scan"];
const REACH = 9; // m, to photos that one can go to
const APART = 0.6; // rad, between ways to them
const MOST_WAYS = 7;
const FAR = 25; // m, of what was not scanned
const SLACK = 0.4; // m
const HERE = 0.3; // m, to photos of the same place
const CLICK = 6; // px, of a pointer that does not turn the view
const SEEN = 0.3; // of the canvas, from its middle: a photo farther out is out of sight
const FOOT = 1.5; // m, height of a camera where no floor is known

interface Way {
  index: number;
  /** From the camera to the foot of the other [m]. */
  to: Vector;
  metres: number;
  button: HTMLButtonElement;
}

export class Viewer {
  private sphere: Sphere | null = null;
  private ways: Way[] = [];
  private asked = 0;
  private pointers = new Map<number, { x: number; y: number }>();
  /** Where the pointer went down that has not turned the view. */
  private click: { x: number; y: number } | null = null;
  private readonly ruler: Ruler;
  private readonly canvas = h("canvas", { class: "sphere" });
  private readonly waysBox = h("div", { class: "ways" });
  private readonly note = h("p", { class: "viewer-note", role: "status" });
  private readonly slider = h("input", { type: "range", min: 0, max: 100, class: "amount" });
  private readonly divider = h("div", { class: "divider", "aria-hidden": "true" });
  private readonly modeButtons: HTMLButtonElement[];
  private readonly differences: HTMLButtonElement;
  private readonly bar: HTMLElement;
  private readonly look = h("div", { class: "look", tabindex: 0, role: "application", "aria-label": text.viewerHelp });

  constructor(
    private readonly model: Model,
    readonly box: HTMLElement,
  ) {
    this.modeButtons = MODES.map((mode) =>
      h("button", { type: "button", "data-mode": mode, onclick: () => this.setMode(mode) }, text.modes[mode]),
    );
    this.differences = h(
      "button",
      { type: "button", class: "toggle", title: text.differencesHelp, onclick: () => this.toggleDifferences() },
      h("span", { class: "swatch", "aria-hidden": "true" }),
      text.differences,
    );
    const modes = h("div", { class: "segments", role: "group", "aria-label": text.modesLabel }, ...this.modeButtons);
    this.look.append(this.canvas);
    box.append(this.look, this.waysBox);
    this.ruler = new Ruler(model, box);
    this.bar = h("div", { class: "viewer-bar" }, modes, this.slider, this.differences, this.ruler.button);
    box.append(this.divider, this.note, h("div", { class: "viewer-foot" }, this.ruler.panel, this.bar));
    this.listen();
    model.on("selected", () => void this.open());
    model.on("alternative", () => void this.open());
    model.on("mode", () => this.combine());
    model.on("view", () => this.looked());
  }

  private listen(): void {
    const { look } = this;
    look.addEventListener("pointerdown", (event) => {
      look.setPointerCapture(event.pointerId);
      this.pointers.set(event.pointerId, { x: event.clientX, y: event.clientY });
      this.click = this.pointers.size === 1 ? { x: event.clientX, y: event.clientY } : null;
    });
    look.addEventListener("pointermove", (event) => this.drag(event));
    look.addEventListener("pointerup", (event) => {
      const box = look.getBoundingClientRect();
      const isPick = this.click && this.model.isMeasuring && event.button === 0;
      if (isPick) this.ruler.pick(event.clientX - box.left, event.clientY - box.top, event.pointerType === "touch");
    });
    for (const name of ["pointerup", "pointercancel"] as const) {
      look.addEventListener(name, (event) => this.pointers.delete(event.pointerId));
    }
    look.addEventListener(
      "wheel",
      (event) => {
        event.preventDefault();
        this.turn(0, 0, Math.exp(Math.max(-200, Math.min(200, event.deltaY)) * 0.0015));
      },
      { passive: false },
    );
    look.addEventListener("keydown", (event) => this.key(event));
    this.slider.addEventListener("input", () => {
      this.model.amount = Number(this.slider.value) / 100;
      this.model.changed("mode");
    });
    this.divider.addEventListener("pointerdown", (event) => this.divider.setPointerCapture(event.pointerId));
    this.divider.addEventListener("pointermove", (event) => {
      if (!this.divider.hasPointerCapture(event.pointerId)) return;
      const box = this.box.getBoundingClientRect();
      this.model.amount = Math.max(0.02, Math.min(0.98, (event.clientX - box.left) / box.width));
      this.model.changed("mode");
    });
    new ResizeObserver(() => this.looked()).observe(this.box);
  }

  toggleMeasuring(): void {
    this.ruler.toggle();
  }

  private drag(event: PointerEvent): void {
    const before = this.pointers.get(event.pointerId);
    if (!before || !this.sphere) return;
    if (this.click && Math.hypot(event.clientX - this.click.x, event.clientY - this.click.y) < CLICK) return;
    this.click = null;
    const other = [...this.pointers].find(([id]) => id !== event.pointerId)?.[1];
    const angle = this.sphere.pixelAngle;
    if (other) {
      const was = Math.hypot(before.x - other.x, before.y - other.y);
      const is = Math.hypot(event.clientX - other.x, event.clientY - other.y);
      if (is > 0) this.turn(0, 0, was / is);
    } else {
      this.turn((event.clientX - before.x) * angle, (event.clientY - before.y) * angle, 1);
    }
    this.pointers.set(event.pointerId, { x: event.clientX, y: event.clientY });
  }

  private key(event: KeyboardEvent): void {
    const turns: Record<string, [number, number, number]> = {
      ArrowLeft: [0.12, 0, 1],
      ArrowRight: [-0.12, 0, 1],
      ArrowUp: [0, 0.1, 1],
      ArrowDown: [0, -0.1, 1],
      "+": [0, 0, 0.85],
      "=": [0, 0, 0.85],
      "-": [0, 0, 1.18],
    };
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    const { clientWidth, clientHeight } = this.canvas;
    const [yaw, pitch, zoom] = turns[event.key] ?? [];
    const part = event.shiftKey ? 0.1 : 1; // finely, to aim
    if (zoom) this.turn(part * yaw, part * pitch, zoom);
    else if (event.key === "Enter" && this.model.isMeasuring) this.ruler.pick(clientWidth / 2, clientHeight / 2, false);
    else if (event.key === "0") this.level();
    else return;
    event.preventDefault();
    event.stopPropagation();
  }

  private level(): void {
    Object.assign(this.model.view, { pitch: 0, fov: FOV });
    this.model.changed("view");
  }

  private turn(yaw: number, pitch: number, zoom: number): void {
    const { view } = this.model;
    view.yaw = Math.atan2(Math.sin(view.yaw + yaw), Math.cos(view.yaw + yaw));
    view.pitch += pitch;
    view.fov *= zoom;
    this.sphere?.look(view); // bounded there
    this.model.changed("view");
  }

  setMode(mode: Mode): void {
    if (!this.model.photo?.pose) return;
    this.model.mode = mode;
    this.model.changed("mode");
  }

  toggleDifferences(): void {
    this.model.showsDifferences = !this.model.showsDifferences;
    this.model.changed("mode");
  }

  /** The pose that is shown: the best, or the alternative chosen. */
  private get pose(): Pose | null {
    const { photo, alternative } = this.model;
    return alternative === null ? (photo?.pose ?? null) : (photo?.alternatives[alternative].pose ?? null);
  }

  /** Show the photo selected. */
  private async open(): Promise<void> {
    const { photo } = this.model;
    const asked = ++this.asked;
    this.findWays(null);
    this.combine();
    if (!photo) return;
    const isTold = photo.status === "unreadable" && this.model.report.service; // by the facts, with a remedy
    if (!photo.hasPictures) return this.say(isTold ? text.noPicture : plain(photo.error ?? text.noPictures), true);
    if (!this.sphere) {
      try {
        this.ruler.sphere = this.sphere = new Sphere(this.canvas);
      } catch {
        return this.say(text.noWebGL, true);
      }
    }
    const late = setTimeout(() => this.say(text.loading, false), 250);
    try {
      const images = await imagesOf(photo, this.sphere.mostWidth);
      if (asked !== this.asked) return;
      const { alternative } = this.model;
      const scan = alternative === null ? images.scan : images.alternatives[alternative] ?? null;
      const rotation = this.pose?.rotation ?? [1, 0, 0, 0, 1, 0, 0, 0, 1];
      this.looked();
      if (alternative === null && !this.model.isViewTold) this.turnTo(images.lit, rotation);
      this.sphere.show({ photo: images.sphere, scan, mask: alternative === null ? images.mask : null, rotation }, true);
      this.say(photo.pose ? "" : text.noScan, false);
      this.findWays(images.depth);
      this.model.changed("measure");
      this.combine();
      this.box.dataset.shown = String(this.model.selected);
    } catch {
      if (asked === this.asked) this.say(text.failed, true);
    } finally {
      clearTimeout(late);
    }
  }

  /** Turn to a photo of which nothing is in sight, as of a phone's after one looked elsewhere. */
  private turnTo(lit: Vector[], rotation: number[]): void {
    const [width, height] = [this.canvas.clientWidth, this.canvas.clientHeight];
    const inPlan = lit.map((ray) => [0, 1, 2].map((k) => ray.reduce((sum, value, row) => sum + value * rotation[3 * row + k], 0)));
    const isSeen = (ray: number[]) => {
      const at = this.sphere!.project(ray as Vector);
      return at !== null && Math.abs(at.x - width / 2) < SEEN * width && Math.abs(at.y - height / 2) < SEEN * height;
    };
    if (!lit.length || inPlan.some(isSeen)) return;
    const [x, y, z] = [0, 1, 2].map((k) => inPlan.reduce((sum, ray) => sum + ray[k], 0));
    Object.assign(this.model.view, { yaw: Math.atan2(y, x), pitch: Math.atan2(z, Math.hypot(x, y)) });
    this.model.changed("view");
  }

  private say(words: string, isAll: boolean): void {
    this.note.textContent = words;
    this.box.classList.toggle("no-picture", isAll);
  }

  private combine(): void {
    const { mode, amount, showsDifferences } = this.model;
    const hasPose = this.model.photo?.pose !== null;
    for (const button of this.modeButtons) {
      button.setAttribute("aria-pressed", String((hasPose ? mode : "photo") === button.dataset.mode));
      button.disabled = !hasPose && button.dataset.mode !== "photo";
    }
    this.differences.setAttribute("aria-pressed", String(showsDifferences));
    this.differences.disabled = !hasPose;
    this.slider.hidden = mode !== "blend" && mode !== "split";
    this.slider.value = String(Math.round(100 * amount));
    this.slider.setAttribute("aria-label", mode === "split" ? text.split : text.blend);
    this.divider.hidden = mode !== "split" || !hasPose;
    this.divider.style.left = `${100 * amount}%`;
    this.sphere?.combine(hasPose ? mode : "photo", amount, showsDifferences);
  }

  private looked(): void {
    this.sphere?.look(this.model.view);
    this.placeWays();
    this.ruler.place();
  }

  /** The photos around that one can go to: the nearest in each direction, of those that the scan lets one see. */
  private findWays(depth: Depth | null): void {
    const from = this.pose;
    this.waysBox.replaceChildren();
    this.ways = [];
    if (!from || !depth || this.model.alternative !== null) return;
    for (const [index, photo, metres] of this.near(from)) {
      const way = this.wayTo(index, photo, metres, from);
      const isFree = metres < HERE || this.ways.every((other) => other.metres < HERE || angleBetween(other.to, way.to) > APART);
      if (!isFree || !isSeen(depth, this.model.photo!, photo.pose!, metres)) continue;
      this.ways.push(way);
      if (this.ways.length === MOST_WAYS) break;
    }
    this.waysBox.append(...this.ways.map((way) => way.button));
    this.placeWays();
  }

  private near(from: Pose): [number, Photo, number][] {
    const { report, selected, photo } = this.model;
    const found: [number, Photo, number][] = [];
    const here: [number, Photo, number][] = [];
    report.photos.forEach((other, index) => {
      const isThere = other.pose && other.status === "localized" && other.storey === photo?.storey;
      if (index === selected || !isThere) return;
      const metres = Math.hypot(...other.pose!.center.map((value, axis) => value - from.center[axis]));
      if (metres < REACH) (metres < HERE ? here : found).push([index, other, metres]);
    });
    const next = here.find(([index]) => index > selected!) ?? here[0]; // round, through all of one place
    return [...(next ? [next] : []), ...found.sort((a, b) => a[2] - b[2])];
  }

  private wayTo(index: number, photo: Photo, metres: number, from: Pose): Way {
    const center = photo.pose!.center;
    const down = photo.height ?? FOOT;
    const to: Vector = [center[0] - from.center[0], center[1] - from.center[1], center[2] - down - from.center[2]];
    const label = text.neighbor(labelOf(photo), metres.toFixed(1));
    const button = h(
      "button",
      { type: "button", class: "way away", "aria-label": label, title: label, onclick: () => this.model.select(index) },
      h("span", { class: "way-ring" }),
    );
    return { index, to, metres, button };
  }

  private placeWays(): void {
    if (!this.sphere) return;
    for (const { to, metres, button } of this.ways) {
      const at = this.sphere.project(to);
      const isShown = at !== null && at.x > -40 && at.y > -40 && at.x < this.box.clientWidth + 40 && at.y < this.box.clientHeight + 40;
      button.classList.toggle("away", !isShown);
      if (!at) continue;
      const flat = Math.max(0.28, Math.min(1, -to[2] / Math.hypot(...to)));
      const size = Math.max(0.55, Math.min(1.7, (2.6 / Math.max(metres, 0.5)) * (1.2 / this.model.view.fov)));
      button.style.transform = `translate(${at.x}px, ${at.y}px) scale(${size}, ${size * flat})`;
      button.style.zIndex = String(Math.round(100 - 10 * metres));
    }
  }
}

/** True if no wall is between two cameras, by how far one can see from the first. */
function isSeen(depth: Depth, photo: Photo, other: Pose, metres: number): boolean {
  const to = other.center.map((value, axis) => value - photo.pose!.center[axis]) as Vector;
  const ranges = samplesAround(depth, inCamera(photo, to)).map(([, range]) => Math.min(range || FAR, FAR));
  return ranges.reduce((sum, range) => sum + range, 0) / ranges.length > metres - SLACK;
}

function angleBetween(a: Vector, b: Vector): number {
  const difference = Math.atan2(a[1], a[0]) - Math.atan2(b[1], b[0]);
  return Math.abs(Math.atan2(Math.sin(difference), Math.cos(difference)));
}
