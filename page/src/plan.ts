/** The plan of a storey on a canvas: moved, zoomed, with the photos as marks that can be opened. */
import type { Model } from "./model";
import { PlanPainter, type Point, SMALL } from "./plan_painter";
import type { Photo } from "./types";

const MOST_ZOOM = 2000; // px a metre
const CLICK = 5; // px that a finger may move

export class Plan extends PlanPainter {
  private pointers = new Map<number, Point>();
  private moved = 0;
  private fitted = "";
  /** Takes the next click on the plan, a place in its frame [m], instead of opening what is there. */
  onPick: ((place: [number, number] | null) => void) | null = null;

  constructor(
    model: Model,
    canvas: HTMLCanvasElement,
    private readonly onView: (scale: number) => void,
  ) {
    super(model, canvas);
    new ResizeObserver(() => this.resized()).observe(canvas);
    canvas.addEventListener("wheel", (event) => this.wheel(event), { passive: false });
    canvas.addEventListener("pointerdown", (event) => this.down(event));
    canvas.addEventListener("pointermove", (event) => this.move(event));
    for (const name of ["pointerup", "pointercancel"] as const) {
      canvas.addEventListener(name, (event) => this.up(event, name === "pointerup"));
    }
    canvas.addEventListener("pointerleave", () => this.hover(null));
    canvas.addEventListener("keydown", (event) => this.key(event));
    canvas.addEventListener("dblclick", (event) => this.zoom(2, this.at(event)));
    model.on("storey", () => this.fit());
  }

  private resized(): void {
    const { clientWidth, clientHeight } = this.canvas;
    const ratio = Math.min(window.devicePixelRatio || 1, 2);
    this.canvas.width = Math.max(1, Math.round(clientWidth * ratio));
    this.canvas.height = Math.max(1, Math.round(clientHeight * ratio));
    const size = `${clientWidth} ${clientHeight}`;
    if (size !== this.fitted) {
      this.fitted = size;
      this.fit();
    }
    this.paint();
  }

  /** Least and greatest x and y of the storey [m]. */
  private bounds(): [number, number, number, number] {
    const xs: number[] = [];
    const ys: number[] = [];
    const plan = this.storey?.plan;
    if (plan) {
      const [a, b, c, d, e, f] = plan.matrix;
      for (const [u, v] of [[0, 0], [plan.width, 0], [0, plan.height], [plan.width, plan.height]]) {
        xs.push(a * u + c * v + e);
        ys.push(b * u + d * v + f);
      }
    }
    for (const { pose, storey, isOnPlan } of this.model.report.photos) {
      if (!pose || !isOnPlan || (plan && storey !== this.model.storey)) continue;
      xs.push(pose.center[0] - 1, pose.center[0] + 1);
      ys.push(pose.center[1] - 1, pose.center[1] + 1);
    }
    if (!xs.length) return [-5, -5, 5, 5];
    return [Math.min(...xs), Math.min(...ys), Math.max(...xs), Math.max(...ys)];
  }

  /** Show all of the storey; of a small map, the photo opened and what is around it. */
  fit(): void {
    const { clientWidth: width, clientHeight: height } = this.canvas;
    if (!width || !height) return;
    const [x0, y0, x1, y1] = this.bounds();
    const pad = Math.min(48, width * 0.06);
    this.scale = Math.min((width - 2 * pad) / (x1 - x0), (height - 2 * pad) / (y1 - y0));
    const pose = this.model.photo?.pose;
    if (width < SMALL && pose && this.model.photo?.storey === this.model.storey) {
      this.scale = Math.max(this.scale, Math.min(width / 9, 40));
      this.center(pose.center[0], pose.center[1]);
    } else {
      this.center((x0 + x1) / 2, (y0 + y1) / 2);
    }
    this.viewChanged();
  }

  private center(x: number, y: number): void {
    this.left = this.canvas.clientWidth / 2 - this.scale * x;
    this.top = this.canvas.clientHeight / 2 + this.scale * y;
  }

  /** Bring a photo into the picture, if it is not well within. */
  reveal(photo: Photo): void {
    if (!photo.pose || !photo.isOnPlan || photo.storey !== this.model.storey) return;
    const [x, y] = photo.pose.center;
    const at = this.toScreen(x, y);
    const { clientWidth: width, clientHeight: height } = this.canvas;
    const margin = Math.min(width, height) * (width < SMALL ? 0.4 : 0.12);
    const isWithin = at.x > margin && at.x < width - margin && at.y > margin && at.y < height - margin;
    if (!isWithin) this.center(x, y);
    this.viewChanged();
  }

  private viewChanged(): void {
    this.onView(this.scale);
    this.draw();
  }

  /** Zoom by a factor about a point of the screen, by default the middle. */
  zoom(factor: number, about: Point = { x: this.canvas.clientWidth / 2, y: this.canvas.clientHeight / 2 }): void {
    const [x0, y0, x1, y1] = this.bounds();
    const least = 60 / Math.max(x1 - x0, y1 - y0);
    const scale = Math.min(Math.max(this.scale * factor, least), MOST_ZOOM);
    const by = scale / this.scale;
    this.left = about.x + by * (this.left - about.x);
    this.top = about.y + by * (this.top - about.y);
    this.scale = scale;
    this.viewChanged();
  }

  pan(dx: number, dy: number): void {
    this.left += dx;
    this.top += dy;
    this.viewChanged();
  }

  private at(event: MouseEvent): Point {
    const box = this.canvas.getBoundingClientRect();
    return { x: event.clientX - box.left, y: event.clientY - box.top };
  }

  private wheel(event: WheelEvent): void {
    event.preventDefault();
    const step = event.deltaMode === WheelEvent.DOM_DELTA_LINE ? 30 : 1;
    this.zoom(Math.exp(-Math.max(-300, Math.min(300, event.deltaY * step)) * 0.002), this.at(event));
  }

  private down(event: PointerEvent): void {
    this.canvas.setPointerCapture(event.pointerId);
    if (!this.pointers.size) this.moved = 0;
    this.pointers.set(event.pointerId, this.at(event));
  }

  private move(event: PointerEvent): void {
    const at = this.at(event);
    const before = this.pointers.get(event.pointerId);
    if (!before) return this.hover(this.photoAt(at, 12));
    const others = [...this.pointers].filter(([id]) => id !== event.pointerId).map(([, point]) => point);
    this.moved += Math.hypot(at.x - before.x, at.y - before.y);
    if (others.length) {
      const [other] = others;
      const was = Math.hypot(before.x - other.x, before.y - other.y);
      const is = Math.hypot(at.x - other.x, at.y - other.y);
      this.pan((at.x - before.x) / 2, (at.y - before.y) / 2);
      if (was > 0) this.zoom(is / was, { x: (at.x + other.x) / 2, y: (at.y + other.y) / 2 });
      this.moved += CLICK;
    } else if (this.moved > CLICK) {
      this.pan(at.x - before.x, at.y - before.y);
    }
    this.pointers.set(event.pointerId, at);
  }

  private up(event: PointerEvent, isClick: boolean): void {
    if (!this.pointers.delete(event.pointerId) || this.pointers.size) return;
    if (!isClick || this.moved > CLICK) return;
    const at = this.at(event);
    if (this.onPick) return this.onPick([(at.x - this.left) / this.scale, (this.top - at.y) / this.scale]);
    const found = this.photoAt(at, event.pointerType === "touch" ? 26 : 14);
    if (found !== null) this.model.select(found);
  }

  private hover(index: number | null): void {
    if (index === this.hovered) return;
    this.hovered = index;
    this.canvas.classList.toggle("pointing", index !== null);
    this.draw();
  }

  /** The photo nearest to a point of the screen, if it is so near [px]; of several at its place, the next. */
  private photoAt(at: Point, reach: number): number | null {
    const distance = (index: number) => Math.hypot(this.markOf(index).x - at.x, this.markOf(index).y - at.y);
    const near = this.shown().filter((index) => distance(index) <= reach);
    if (!near.length) return null;
    const nearest = near.reduce((one, other) => (distance(other) < distance(one) ? other : one));
    const stack = near.filter((index) => this.placeOf(index) === this.placeOf(nearest));
    const next = stack.indexOf(this.model.selected ?? -1) + 1;
    return next ? stack[next % stack.length] : nearest;
  }

  private key(event: KeyboardEvent): void {
    const steps: Record<string, [number, number]> = {
      ArrowLeft: [60, 0],
      ArrowRight: [-60, 0],
      ArrowUp: [0, 60],
      ArrowDown: [0, -60],
    };
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    if (steps[event.key]) this.pan(...steps[event.key]);
    else if (event.key === "+" || event.key === "=") this.zoom(1.3);
    else if (event.key === "-") this.zoom(1 / 1.3);
    else if (event.key === "0") this.fit();
    else return;
    event.preventDefault();
    event.stopPropagation();
  }
}
