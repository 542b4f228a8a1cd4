/** The list of photos: only rows in sight are elements, so that thousands stay smooth. */
import { h } from "./dom";
import { badge, verdictOf } from "./marks";
import type { Model } from "./model";
import { labelOf } from "./plan_painter";
import { plain, text } from "./text";
import type { Photo } from "./types";

const ROW = 76; // px
const BEYOND = 4; // rows made above and below those in sight

export class List {
  private readonly rows = new Map<number, HTMLElement>();
  private readonly spacer = h("div", { class: "spacer", role: "presentation" });
  private readonly empty = h("p", { class: "empty" }, text.nothingFound);
  /** Place in the list that the keyboard is at. */
  private active = 0;

  constructor(
    private readonly model: Model,
    private readonly box: HTMLElement,
  ) {
    box.append(this.spacer);
    box.after(this.empty);
    box.addEventListener("scroll", () => this.render(), { passive: true });
    box.addEventListener("keydown", (event) => this.key(event));
    box.addEventListener("focus", () => this.render());
    new ResizeObserver(() => this.render()).observe(box);
    model.on("list", () => {
      this.clear();
      this.active = Math.max(0, this.place());
      this.render();
    });
    model.on("selected", () => {
      const place = this.place();
      if (place >= 0) this.moveTo(place);
      this.clear();
      this.render();
    });
    this.render();
  }

  private place(): number {
    return this.model.selected === null ? -1 : this.model.listed.indexOf(this.model.selected);
  }

  private clear(): void {
    for (const row of this.rows.values()) row.remove();
    this.rows.clear();
  }

  /** Make the rows in sight, drop the others. */
  private render(): void {
    const { listed } = this.model;
    this.spacer.style.height = `${listed.length * ROW}px`;
    this.empty.hidden = listed.length > 0;
    const first = Math.max(0, Math.floor(this.box.scrollTop / ROW) - BEYOND);
    const last = Math.min(listed.length, Math.ceil((this.box.scrollTop + this.box.clientHeight) / ROW) + BEYOND);
    for (const [place, row] of this.rows) {
      if (place < first || place >= last) {
        row.remove();
        this.rows.delete(place);
      }
    }
    for (let place = first; place < last; place++) {
      if (!this.rows.has(place)) this.spacer.append(this.row(place));
    }
    const isInSight = this.active >= first && this.active < last;
    if (isInSight) this.box.setAttribute("aria-activedescendant", `row-${this.active}`);
    else this.box.removeAttribute("aria-activedescendant");
  }

  private row(place: number): HTMLElement {
    const index = this.model.listed[place];
    const photo = this.model.report.photos[index];
    const isSelected = index === this.model.selected;
    const without = () => h("span", { class: "no-picture", "aria-hidden": "true" }, badge(photo.status));
    const picture = photo.thumb ? h("img", { src: photo.thumb, alt: "", width: 96, height: 60, decoding: "async" }) : without();
    picture.addEventListener("error", () => picture.replaceWith(without()));
    const row = h(
      "div",
      {
        class: `row ${isSelected ? "selected" : ""} ${place === this.active ? "active" : ""}`,
        role: "option",
        id: `row-${place}`,
        "aria-selected": String(isSelected),
        "aria-setsize": this.model.listed.length,
        "aria-posinset": place + 1,
        onclick: () => this.model.select(index),
      },
      picture,
      h(
        "div",
        { class: "row-text" },
        h("div", { class: "row-name", title: photo.name }, labelOf(photo)),
        h("div", { class: `row-status ${photo.status}` }, badge(photo.status), verdictOf(photo)),
        h("div", { class: "row-facts" }, this.facts(photo)),
      ),
    );
    row.style.transform = `translateY(${place * ROW}px)`;
    this.rows.set(place, row);
    return row;
  }

  private facts(photo: Photo): string {
    if (this.model.report.service && photo.error) return plain(photo.error);
    const storey = this.model.report.storeys.length > 1 && photo.pose ? this.model.report.storeys[photo.storey ?? 0].name : null;
    if (photo.contradicts.length) return ""; // its verdict is long, and the confidence is that of what was told
    const sure = photo.pose ? `${percent(photo.confidence)}` : null;
    const spread = photo.spread ? `±${length(photo.spread.largest)}` : null;
    return [sure, spread, storey].filter(Boolean).join(" · ");
  }

  private moveTo(place: number): void {
    this.rows.get(this.active)?.classList.remove("active");
    this.active = place;
    const top = place * ROW;
    if (top < this.box.scrollTop) this.box.scrollTop = top;
    else if (top + ROW > this.box.scrollTop + this.box.clientHeight) this.box.scrollTop = top + ROW - this.box.clientHeight;
    this.render();
    this.rows.get(place)?.classList.add("active");
  }

  private key(event: KeyboardEvent): void {
    const page = Math.max(1, Math.floor(this.box.clientHeight / ROW) - 1);
    const last = this.model.listed.length - 1;
    const to: Record<string, number> = {
      ArrowDown: this.active + 1,
      ArrowUp: this.active - 1,
      PageDown: this.active + page,
      PageUp: this.active - page,
      Home: 0,
      End: last,
    };
    if (event.key in to && last >= 0) this.moveTo(Math.max(0, Math.min(last, to[event.key])));
    else if ((event.key === "Enter" || event.key === " ") && last >= 0) this.model.select(this.model.listed[this.active]);
    else return;
    event.preventDefault();
    event.stopPropagation();
  }
}

/** A probability for reading; never 100 % by rounding. */
export function percent(value: number): string {
  const shown = 100 * value;
  if (shown >= 99.95 && value < 1) return "> 99.9 %";
  if (shown < 0.05 && value > 0) return "< 0.1 %";
  return `${shown.toFixed(shown < 10 || shown >= 99 ? 1 : 0)} %`;
}

/** Millimetres for reading. */
export function length(mm: number): string {
  if (mm >= 1000) return `${(mm / 1000).toFixed(2)} m`;
  return mm >= 100 ? `${(mm / 10).toFixed(0)} cm` : `${Number(mm.toFixed(mm < 10 ? 1 : 0))} mm`;
}
