/** What the plan of a storey shows: the picture, walks, marks, names. */
import { trace } from "./marks";
import { ahead, type Model } from "./model";
import { text } from "./text";
import type { Photo, Status, Storey } from "./types";

const MANY = 400; // photos in sight, of which only marks are drawn
export const SMALL = 420; // px, width of a plan in a corner
const SPOT = 0.15; // m, photos nearer than that are counted where they are
const MARK = 6; // px, nearer than these, too
const WEDGE_FROM = 9; // px a metre, from which headings are drawn
const NAMES_FROM = 42; // px a metre, from which names are

export interface Point {
  x: number;
  y: number;
}

/** Colours of the theme, by the names of CSS variables, asked for once. */
function colors(element: Element): (name: string) => string {
  const style = getComputedStyle(element);
  const known = new Map<string, string>();
  return (name) => {
    if (!known.has(name)) known.set(name, style.getPropertyValue(`--${name}`).trim());
    return known.get(name)!;
  };
}

export class PlanPainter {
  private readonly context: CanvasRenderingContext2D;
  private readonly images = new Map<string, HTMLImageElement>();
  /** Screen = scale * (x, -y) + (left, top), in CSS px of metres. */
  protected scale = 0;
  protected left = 0;
  protected top = 0;
  protected hovered: number | null = null;
  private frame = 0;
  private color: (name: string) => string;
  /** Marks and sectors drawn once, by what they show: gradients are slow. */
  private readonly sprites = new Map<string, HTMLCanvasElement>();

  constructor(
    protected readonly model: Model,
    readonly canvas: HTMLCanvasElement,
  ) {
    this.context = canvas.getContext("2d")!;
    this.color = colors(canvas);
    model.on("list selected view", () => this.draw());
  }

  protected get storey(): Storey | undefined {
    return this.model.report.storeys[this.model.storey];
  }

  protected toScreen(x: number, y: number): Point {
    return { x: this.scale * x + this.left, y: this.top - this.scale * y };
  }

  /** Photos of the list that lie on this storey. */
  protected shown(): number[] {
    const { photos } = this.model.report;
    return this.model.listed.filter((index) => photos[index].isOnPlan && photos[index].storey === this.model.storey);
  }

  private image(): HTMLImageElement | null {
    const file = this.storey?.plan?.file;
    if (!file) return null;
    let image = this.images.get(file);
    if (!image) {
      image = new Image();
      image.addEventListener("load", () => this.draw());
      image.src = file;
      this.images.set(file, image);
    }
    return image.complete && image.naturalWidth ? image : null;
  }

  protected paint(): void {
    const { context, canvas } = this;
    const ratio = canvas.width / Math.max(1, canvas.clientWidth);
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    context.clearRect(0, 0, canvas.clientWidth, canvas.clientHeight);
    this.paintGrid();
    this.paintImage(ratio);
    for (const walk of this.model.walks.values()) this.paintWalk(walk);
    const shown = this.shown().filter((index) => this.isSeen(this.markOf(index)));
    const { selected } = this.model;
    const isSmall = Math.max(this.canvas.clientWidth, this.canvas.clientHeight) < SMALL;
    const isDense = shown.length > MANY;
    const radius = Math.max(4, Math.min(isSmall || isDense ? 5 : 8, this.scale * 0.28));
    if (this.scale > WEDGE_FROM && !isSmall && !isDense) for (const index of shown) if (index !== selected) this.paintWedge(index, radius);
    for (const index of shown) if (index !== selected) this.paintMark(index, radius);
    if (selected !== null) this.paintSelected(selected, radius + 2);
    this.paintNames(shown, radius);
    if (!isDense && !isSmall) this.paintCounts(shown, radius);
  }

  /** How many photos there are where several lie on each other. */
  private paintCounts(shown: number[], radius: number): void {
    const counts = new Map<string, number[]>();
    for (const index of shown) counts.set(this.placeOf(index), [...(counts.get(this.placeOf(index)) ?? []), index]);
    for (const [first, ...others] of counts.values()) {
      const at = this.markOf(first);
      if (others.length) this.label(`×${others.length + 1}`, at.x + radius + 16, at.y);
    }
  }

  /** The place of a mark, which those that cover each other have in common. */
  protected placeOf(index: number): string {
    const [x, y] = this.model.report.photos[index].pose!.center;
    const side = Math.min(SPOT, MARK / this.scale);
    return `${Math.round(x / side)} ${Math.round(y / side)}`;
  }

  private paintGrid(): void {
    const { context, canvas } = this;
    const step = [1, 5, 10, 50, 100, 500, 1000].find((metres) => metres * this.scale > 34) ?? 5000;
    context.fillStyle = this.color("grid");
    const { clientWidth: width, clientHeight: height } = canvas;
    for (let x = Math.ceil(-this.left / this.scale / step) * step; this.toScreen(x, 0).x < width; x += step) {
      for (let y = Math.ceil((this.top - height) / this.scale / step) * step; this.toScreen(0, y).y > 0; y += step) {
        const at = this.toScreen(x, y);
        context.fillRect(at.x - 1, at.y - 1, 2, 2);
      }
    }
  }

  private paintImage(ratio: number): void {
    const image = this.image();
    const plan = this.storey?.plan;
    if (!image || !plan) return;
    const { context, scale } = this;
    const [a, b, c, d, e, f] = plan.matrix;
    const s = scale * ratio;
    context.save();
    context.setTransform(s * a, -s * b, s * c, -s * d, s * e + this.left * ratio, this.top * ratio - s * f);
    context.imageSmoothingEnabled = scale * plan.pixel < 6;
    context.imageSmoothingQuality = "high";
    context.globalAlpha = Number(this.color("plan-alpha")) || 1;
    context.drawImage(image, 0, 0, plan.width, plan.height);
    context.restore();
  }

  /** The path of a walk, where it is on this storey. */
  private paintWalk(walk: number[]): void {
    const { context } = this;
    const { photos } = this.model.report;
    context.beginPath();
    let isOn = false;
    for (const index of walk) {
      const { pose, storey, status, gap } = photos[index];
      const isHere = pose !== null && storey === this.model.storey && status === "localized";
      if (isHere) {
        const at = this.toScreen(pose.center[0], pose.center[1]);
        if (isOn && !gap) context.lineTo(at.x, at.y);
        else context.moveTo(at.x, at.y);
      }
      if (pose) isOn = isHere;
    }
    context.lineJoin = context.lineCap = "round";
    for (const [width, color] of [[5, "halo"], [2.5, "walk"]] as const) {
      context.lineWidth = width;
      context.strokeStyle = this.color(color);
      context.stroke();
    }
  }

  private statusColor(status: Status): string {
    return this.color(status.replace("_", "-"));
  }

  /** A drawing of `size` x `size` px around the middle, made once under a name. */
  private sprite(name: string, size: number, paint: (context: CanvasRenderingContext2D) => void): HTMLCanvasElement {
    const ratio = this.canvas.width / Math.max(1, this.canvas.clientWidth);
    const key = `${name} ${size.toFixed(1)} ${ratio}`;
    let made = this.sprites.get(key);
    if (!made) {
      if (this.sprites.size > 100) this.sprites.clear();
      made = document.createElement("canvas");
      made.width = made.height = Math.ceil(size * ratio);
      const context = made.getContext("2d")!;
      context.setTransform(ratio, 0, 0, ratio, made.width / 2, made.width / 2);
      paint(context);
      this.sprites.set(key, made);
    }
    return made;
  }

  private paintWedge(index: number, radius: number): void {
    const { context } = this;
    const photo = this.model.report.photos[index];
    const at = this.markOf(index);
    const reach = radius * 3.6;
    const sector = this.sprite(`sector ${photo.status}`, 2 * reach, (own) =>
      paintSector(own, { x: 0, y: 0 }, [0, 0.45, reach], this.statusColor(photo.status), photo.status === "localized" ? 0.75 : 0.25),
    );
    context.save();
    context.translate(at.x, at.y);
    context.rotate(-ahead(photo).yaw);
    context.drawImage(sector, -reach, -reach, 2 * reach, 2 * reach);
    context.restore();
  }

  protected markOf(index: number): Point {
    const [x, y] = this.model.report.photos[index].pose!.center;
    return this.toScreen(x, y);
  }

  private isSeen(at: Point): boolean {
    const { clientWidth, clientHeight } = this.canvas;
    return at.x > -50 && at.y > -50 && at.x < clientWidth + 50 && at.y < clientHeight + 50;
  }

  private paintMark(index: number, radius: number): void {
    const { context } = this;
    const photo = this.model.report.photos[index];
    const at = this.markOf(index);
    this.paintEllipse(photo, at);
    const grown = index === this.hovered ? radius + 2 : radius;
    const size = 2 * (1.2 * grown + 3);
    const mark = this.sprite(`mark ${photo.status}`, size, (own) => {
      trace(own, photo.status, 0, 0, grown);
      const isSure = photo.status === "localized"; // a guess is hollow
      own.fillStyle = isSure ? this.statusColor(photo.status) : `${this.color("halo")}b0`;
      own.fill();
      own.lineWidth = 2;
      own.strokeStyle = isSure ? this.color("halo") : this.statusColor(photo.status);
      own.stroke();
    });
    context.drawImage(mark, at.x - size / 2, at.y - size / 2, size, size);
  }

  private paintEllipse(photo: Photo, at: Point): void {
    if (!photo.spread) return;
    const [a, b, degrees] = photo.spread.ellipse;
    if (a * this.scale < 2) return;
    const { context } = this;
    context.beginPath();
    context.ellipse(at.x, at.y, a * this.scale, b * this.scale, (-degrees * Math.PI) / 180, 0, 2 * Math.PI);
    context.fillStyle = `${this.statusColor(photo.status)}33`;
    context.fill();
    context.lineWidth = 1.5;
    context.strokeStyle = this.statusColor(photo.status);
    context.stroke();
  }

  private paintSelected(index: number, radius: number): void {
    const { context, model } = this;
    const photo = model.report.photos[index];
    if (!photo.pose || !photo.isOnPlan) return;
    const away = model.alternative === null ? null : photo.alternatives[model.alternative];
    this.paintAlternatives(photo);
    const { center } = (away ?? photo).pose!;
    if ((away ?? photo).storey !== model.storey) return;
    const at = this.toScreen(center[0], center[1]);
    const { view } = model;
    const half = Math.atan(Math.tan(view.fov / 2) * 1.3);
    const reach = Math.max(46, Math.min(110, this.scale * 3));
    paintSector(context, at, [view.yaw, half, reach], this.color("accent"), 0.85);
    this.paintEllipse(photo, at);
    context.beginPath();
    context.arc(at.x, at.y, radius + 5, 0, 2 * Math.PI);
    context.fillStyle = this.color("halo");
    context.fill();
    context.lineWidth = 3;
    context.strokeStyle = this.color("accent");
    context.stroke();
    trace(context, photo.status, at.x, at.y, radius - 1);
    context.fillStyle = this.statusColor(photo.status);
    context.fill();
  }

  /** Where else an ambiguous photo may have been taken, joined to the best pose. */
  private paintAlternatives(photo: Photo): void {
    if (photo.status === "localized") return;
    const { context } = this;
    const from = this.toScreen(photo.pose!.center[0], photo.pose!.center[1]);
    for (const alternative of photo.alternatives) {
      if (alternative.storey !== this.model.storey) continue;
      const at = this.toScreen(alternative.pose.center[0], alternative.pose.center[1]);
      context.strokeStyle = this.statusColor(photo.status);
      context.lineWidth = 1.5;
      context.setLineDash([5, 5]);
      context.beginPath();
      context.moveTo(from.x, from.y);
      context.lineTo(at.x, at.y);
      context.stroke();
      context.setLineDash([]);
      trace(context, "ambiguous", at.x, at.y, 7);
      context.fillStyle = this.color("halo");
      context.fill();
      context.stroke();
      this.label(`${Math.round(100 * alternative.probability)} %`, at.x, at.y - 12);
    }
  }

  /** Names beside the marks, as far as they do not cover each other. */
  private paintNames(shown: number[], radius: number): void {
    const { model } = this;
    const first = [this.hovered, model.selected].filter((index) => index !== null && shown.includes(index)) as number[];
    const wanted = this.scale > NAMES_FROM && shown.length <= MANY ? [...first, ...shown] : first;
    const taken: [number, number, number][] = [];
    for (const index of new Set(wanted)) {
      const at = this.markOf(index);
      const photo = model.report.photos[index];
      const name = photo.status === "localized" ? labelOf(photo) : text.guess(labelOf(photo));
      const half = name.length * 3.8 + 6;
      const y = at.y - radius - (index === model.selected ? 17 : 10);
      if (taken.some(([x, other, reach]) => Math.abs(at.x - x) < half + reach && Math.abs(y - other) < 20)) continue;
      taken.push([at.x, y, half]);
      this.label(name, at.x, y);
    }
  }

  private label(words: string, x: number, y: number): void {
    const { context } = this;
    context.font = "600 12px system-ui, sans-serif";
    context.textAlign = "center";
    context.textBaseline = "middle";
    const half = context.measureText(words).width / 2 + 7;
    context.fillStyle = this.color("label");
    context.beginPath();
    context.roundRect(x - half, y - 10, 2 * half, 20, 6);
    context.fill();
    context.fillStyle = this.color("label-ink");
    context.fillText(words, x, y + 0.5);
  }

  /** Draw soon, once however often it is asked for. */
  draw(): void {
    this.frame ||= requestAnimationFrame(() => {
      this.frame = 0;
      this.paint();
    });
  }

  themed(): void {
    this.color = colors(this.canvas);
    this.sprites.clear();
    this.draw();
  }
}

/** What a camera looks at: a sector that fades out, by azimuth of the plan, half its angle [rad], reach [px]. */
function paintSector(
  context: CanvasRenderingContext2D,
  at: Point,
  [yaw, half, reach]: [number, number, number],
  color: string,
  strength: number,
): void {
  const gradient = context.createRadialGradient(at.x, at.y, 0, at.x, at.y, reach);
  gradient.addColorStop(0, color);
  gradient.addColorStop(1, `${color}00`);
  context.globalAlpha = strength;
  context.fillStyle = gradient;
  context.beginPath();
  context.moveTo(at.x, at.y);
  context.arc(at.x, at.y, reach, -yaw - half, -yaw + half);
  context.closePath();
  context.fill();
  context.globalAlpha = 1;
}

/** What a photo is called where there is little room. */
export function labelOf({ short }: Photo): string {
  return short.length > 28 ? `${short.slice(0, 9)}…${short.slice(-17)}` : short;
}
