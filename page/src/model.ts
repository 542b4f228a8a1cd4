/** What is chosen on the page, and who wants to know of it. */
import type { Spot } from "./measure";
import { STATUSES, type Photo, type Report, type Status } from "./types";

export type Mode = "photo" | "blend" | "split" | "scan";
export type Sort = "order" | "taken" | "name" | "confidence" | "storey";
export interface View {
  /** Azimuth in the plan's frame, counterclockwise from +x, elevation, vertical field [rad]. */
  yaw: number;
  pitch: number;
  fov: number;
}

export const FOV = 1.4;
const NAMES = new Intl.Collator("en", { numeric: true, sensitivity: "base" });

/** All state of the page; `changed` is told by name what has changed. */
export class Model {
  selected: number | null = null;
  alternative: number | null = null;
  storey = 0;
  mode: Mode = "photo";
  amount = 0.5;
  showsDifferences = false;
  isMeasuring = false;
  /** Between which it is measured, none to two, of any photos. */
  spots: Spot[] = [];
  view: View = { yaw: 0, pitch: 0, fov: FOV };
  /** True if a link told the view, which then stays as it is. */
  isViewTold = false;
  search = "";
  statuses = new Set<Status>(STATUSES);
  onlyStorey: number | null = null;
  minConfidence = 0;
  sort: Sort = "order";
  /** Indices of the photos listed, in order. */
  listed: number[] = [];
  readonly walks: Map<number, number[]>;
  private listeners: Record<string, (() => void)[]> = {};

  constructor(readonly report: Report) {
    this.walks = walksOf(report.photos);
    const first = report.photos.find((photo) => photo.storey !== null);
    this.storey = first?.storey ?? 0;
    this.list();
  }

  on(names: string, listener: () => void): void {
    for (const name of names.split(" ")) (this.listeners[name] ??= []).push(listener);
  }

  changed(name: string): void {
    for (const listener of this.listeners[name] ?? []) listener();
  }

  /** False where a link would find nothing: what was dropped is lost with the page, unless the service keeps it. */
  get hasLinks(): boolean {
    return this.report.service?.keepsPhotos ?? true;
  }

  get photo(): Photo | null {
    return this.selected === null ? null : this.report.photos[this.selected];
  }

  /** Photos that pass the filters, whatever their status. */
  private passes(photo: Photo, index: number, words: string[]): boolean {
    const label = `${photo.name} ${index + 1}`.toLowerCase();
    return (
      words.every((word) => label.includes(word)) &&
      (this.onlyStorey === null || photo.storey === this.onlyStorey) &&
      photo.confidence >= this.minConfidence
    );
  }

  /** Make the list anew from filters and order. */
  list(): void {
    const { photos } = this.report;
    const words = this.search.toLowerCase().split(/\s+/).filter(Boolean);
    const found = [...photos.keys()].filter(
      (index) => this.statuses.has(photos[index].status) && this.passes(photos[index], index, words),
    );
    const storey = (index: number) => photos[index].storey ?? Number.MAX_SAFE_INTEGER;
    const orders: Record<Sort, (a: number, b: number) => number> = {
      order: (a, b) => a - b,
      taken: (a, b) => takenAt(photos[a]) - takenAt(photos[b]),
      name: (a, b) => NAMES.compare(photos[a].name, photos[b].name),
      confidence: (a, b) => photos[a].confidence - photos[b].confidence,
      storey: (a, b) => storey(a) - storey(b),
    };
    this.listed = found.sort((a, b) => orders[this.sort](a, b) || a - b);
    this.changed("list");
  }

  /** Add a photo, or put it in the place of another. */
  put(photo: Photo, old?: Photo): void {
    const { photos } = this.report;
    const at = old ? photos.indexOf(old) : photos.length;
    photos[at] = photo;
    this.list();
    if (at !== this.selected) return;
    this.selected = null; // so that it is looked at from its front
    this.select(at);
  }

  remove(photo: Photo): void {
    const at = this.report.photos.indexOf(photo);
    if (this.photo === photo) this.select(null);
    this.report.photos.splice(at, 1);
    this.spots = []; // they know their photos by place
    if (this.selected !== null && this.selected > at) this.selected--;
    this.list();
  }

  /** Open a photo; `view` is kept if none is given, so that a step along a walk goes on looking ahead. */
  select(index: number | null, view: Partial<View> | null = null): void {
    const before = this.selected;
    this.selected = index;
    this.alternative = null;
    const photo = this.photo;
    if (photo?.pose && view === null && before === null) this.view = { ...this.view, ...ahead(photo), pitch: 0, fov: FOV };
    this.isViewTold = view !== null;
    if (view) this.view = { ...this.view, ...view };
    if (photo && !photo.pose) this.view = { ...this.view, ...(view ?? { yaw: 0, pitch: 0 }) };
    if (photo && photo.storey !== null) this.storey = photo.storey;
    this.changed("selected");
  }

  /** The photo before or after the one opened: along its walk, or else in the list. */
  step(by: 1 | -1): void {
    const photo = this.photo;
    const walk = photo && photo.walk !== null ? this.walks.get(photo.walk)! : null;
    const order = walk ?? this.listed;
    if (!order.length) return;
    const at = this.selected === null ? -1 : order.indexOf(this.selected);
    const to = at < 0 ? (by > 0 ? 0 : order.length - 1) : at + by;
    if (to >= 0 && to < order.length) this.select(order[to]);
  }

  /** Place of the photo opened among those that `step` goes through, and how many they are. */
  get place(): [number, number] {
    const photo = this.photo;
    const order = photo && photo.walk !== null ? this.walks.get(photo.walk)! : this.listed;
    return [this.selected === null ? -1 : order.indexOf(this.selected), order.length];
  }
}

/** When a photo was taken, for comparing; what does not say so comes last. */
export function takenAt(photo: Photo): number {
  return photo.captured ? Date.parse(photo.captured) : Number.MAX_SAFE_INTEGER;
}

/** The azimuth at which the middle of a photo looks. */
export function ahead(photo: Photo): { yaw: number } {
  const rotation = photo.pose!.rotation;
  return { yaw: Math.atan2(rotation[1], rotation[0]) };
}

function walksOf(photos: Photo[]): Map<number, number[]> {
  const walks = new Map<number, number[]>();
  photos.forEach((photo, index) => {
    if (photo.walk === null) return;
    if (!walks.has(photo.walk)) walks.set(photo.walk, []);
    walks.get(photo.walk)!.push(index);
  });
  for (const walk of walks.values()) walk.sort((a, b) => photos[a].time! - photos[b].time! || a - b);
  return walks;
}
