/** Measuring on the photo that is opened: points are picked, and their distance is drawn over the sphere. */
import { h, icon, svg } from "./dom";
import { copyButton, doingButton } from "./facts";
import { linkOf } from "./link";
import { distanceBetween, inCamera, pointAt, type Point, type Spot } from "./measure";
import { type Measurement, Measurements } from "./measurements";
import type { Model } from "./model";
import { imagesOf } from "./pictures";
import type { Sphere } from "./sphere";
import { text } from "./text";
import type { Vector } from "./types";

const POINTING = 0.5; // px of the photo, and of the screen, by which a mouse is off
const FINGER = 4; // px of the screen, by which a finger is
const PARTS = 64; // of the line: those behind the camera are not drawn

export class Ruler {
  sphere: Sphere | null = null;
  readonly button: HTMLButtonElement;
  readonly panel: HTMLElement;
  private points: Point[] = [];
  private asked = 0;
  private readonly drawing = svg("svg", { class: "ruler", "aria-hidden": "true" });
  private readonly label = h("div", { class: "ruler-label", "aria-hidden": "true" });
  private readonly words = h("p", { role: "status" });
  private readonly copies: HTMLElement;

  constructor(
    private readonly model: Model,
    private readonly box: HTMLElement,
  ) {
    this.button = h("button", { type: "button", class: "toggle", title: text.measureHelp, onclick: () => this.toggle() }, icon("ruler"), text.measure);
    const names = () => this.points.map(({ spot }) => model.report.photos[spot.photo].name).join(", ");
    const measurements = new Measurements(model.report);
    const keep = doingButton("plus", text.keepDistance, text.keptDistance, () => measurements.add(this.measurement()));
    this.copies = h("div", { class: "copies" }, copyButton("copy", text.copyDistance, () => `${this.told()} (${names()})`), keep);
    this.panel = h("div", { class: "ruler-panel" }, this.words, this.copies, measurements.button);
    box.append(this.drawing, h("div", { class: "reticle", "aria-hidden": "true" }), this.label);
    model.on("measure selected alternative", () => void this.find());
  }

  toggle(): void {
    if (!this.model.isMeasuring && !this.canPick) return;
    this.model.isMeasuring = !this.model.isMeasuring;
    this.model.spots = [];
    this.model.changed("measure");
  }

  /** True where the scan's depth from the pose that is shown is known. */
  private get canPick(): boolean {
    const { photo, alternative } = this.model;
    return Boolean(photo?.hasPictures && photo.pose) && alternative === null;
  }

  /** Find the points of all spots, for which other photos' pictures may have to be read. */
  private async find(): Promise<void> {
    const { model } = this;
    const asked = ++this.asked;
    if (!this.sphere) return this.say(""); // it comes with the first photo's pictures
    const found = await Promise.all(model.spots.map((spot) => this.pointOf(spot)));
    if (asked !== this.asked) return;
    this.points = found.filter((point) => point !== null);
    model.spots = this.points.map((point) => point.spot);
    this.say(this.points.length < found.length ? text.notScanned : "");
    this.place();
  }

  private async pointOf(spot: Spot): Promise<Point | null> {
    const photo = this.model.report.photos[spot.photo];
    if (!photo.pose || !photo.hasPictures) return null;
    const images = await imagesOf(photo, this.sphere!.mostWidth).catch(() => null); // the viewer tells
    return images?.depth ? pointAt(spot, images.depth, photo) : null;
  }

  private say(said: string): void {
    const { model, points } = this;
    this.button.setAttribute("aria-pressed", String(model.isMeasuring));
    this.button.disabled = !model.isMeasuring && !this.canPick;
    this.box.classList.toggle("measuring", model.isMeasuring);
    this.copies.hidden = points.length < 2;
    const notes = [
      said || (points.length > 1 ? this.told() : text.pick[points.length]),
      points.some((point) => point.isAtEdge) ? text.atEdge : "",
      points.some(({ spot }) => model.report.photos[spot.photo].status !== "localized") ? text.unsurePose : "",
    ];
    this.words.replaceChildren(...notes.filter(Boolean).map((note, index) => h("span", { class: index ? "quiet" : "" }, note)));
  }

  private told(): string {
    const { gap, metres, deviation } = distanceBetween(this.points[0], this.points[1], this.model.report.photos);
    return text.distance(metres, deviation) + text.parts(Math.hypot(gap[0], gap[1]), Math.abs(gap[2]), deviation);
  }

  /** The distance that is shown, with what a list of them needs. */
  private measurement(): Measurement {
    const { model, points } = this;
    const { photos, R, origin } = model.report;
    const { gap, metres, deviation } = distanceBetween(points[0], points[1], photos);
    const inWorld = ({ at }: Point) => origin.map((value, k) => value + R[k] * at[0] + R[3 + k] * at[1] + R[6 + k] * at[2]) as Vector;
    return {
      ...{ note: "", metres, deviation, horizontal: Math.hypot(gap[0], gap[1]), vertical: Math.abs(gap[2]) },
      ...{ photos: points.map(({ spot }) => photos[spot.photo].name), points: points.map(inWorld), link: linkOf(model) },
    };
  }

  /** Pick the point under a place of the canvas [px]; the third one begins anew. */
  pick(x: number, y: number, isFinger: boolean): void {
    const { model, sphere } = this;
    if (!sphere || !this.canPick) return this.say(text.noDepth);
    const angle = Math.hypot((POINTING * 2 * Math.PI) / sphere.photoWidth, (isFinger ? FINGER : POINTING) * sphere.pixelAngle);
    const spot = { photo: model.selected!, ray: inCamera(model.photo!, sphere.rayAt(x, y)), angle };
    model.spots = [...(model.spots.length > 1 ? [] : model.spots), spot];
    model.changed("measure");
  }

  /** Draw marks, line and label where they are seen now. */
  place(): void {
    const { model, sphere, points, box } = this;
    const center = model.photo?.pose?.center;
    const ends = center && sphere ? points.map(({ at }) => at.map((value, k) => value - center[k])) : [];
    const along = (part: number) => sphere!.project(ends[0].map((value, k) => value + part * (ends[1][k] - value)) as Vector);
    const line = ends.length > 1 ? Array.from({ length: PARTS + 1 }, (_, k) => along(k / PARTS)).filter((at) => at !== null) : [];
    const path = line.map(({ x, y }) => `${x},${y}`).join(" ");
    const marks = ends.map((end) => sphere!.project(end as Vector)).filter((at) => at !== null);
    this.drawing.replaceChildren(
      ...(path ? ["halo", "line"].map((name) => svg("polyline", { points: path, class: name })) : []),
      ...marks.flatMap(({ x, y }) => [9, 2].map((r) => svg("circle", { cx: x, cy: y, r, class: r > 2 ? "ring" : "dot" }))),
    );
    this.label.hidden = !path;
    if (!path) return;
    const { metres, deviation } = distanceBetween(points[0], points[1], model.report.photos);
    this.label.textContent = text.distance(metres, deviation);
    const middle = line[Math.floor(line.length / 2)];
    const x = Math.max(90, Math.min(box.clientWidth - 90, middle.x));
    const y = Math.max(80, Math.min(box.clientHeight - 80, middle.y));
    this.label.style.transform = `translate(${x}px, ${y}px) translate(-50%, -150%)`;
  }
}
