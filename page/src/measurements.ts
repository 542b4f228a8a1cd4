/** The list of distances that were kept: a browser saves it for each scan, and it is downloaded as a table. */
import { h, icon, iconButton } from "./dom";
import { saveTable } from "./table";
import { text } from "./text";
import type { Report, Vector } from "./types";

const KEY = "piccolo-measurements";
const COLUMNS = ["note", "distance_m", "std_m", "horizontal_m", "vertical_m", "photo_1", "x_1", "y_1", "z_1", "photo_2", "x_2", "y_2", "z_2"];
const METRES = 4; // digits

/** A distance between two points, in the world's frame [m]; its deviation [m], null if it is not known. */
export interface Measurement {
  note: string;
  metres: number;
  deviation: number | null;
  horizontal: number;
  vertical: number;
  photos: string[];
  points: Vector[];
  /** The part of the page's address behind # that shows it. */
  link: string;
}

export class Measurements {
  /** Opens the list. */
  readonly button: HTMLButtonElement;
  private readonly caption = h("span");
  private readonly body = h("tbody");
  private readonly box = h("dialog", { class: "help measurements", "aria-label": text.measurements });
  private readonly key: string;
  private all: Measurement[];

  constructor(private readonly report: Report) {
    this.key = `${KEY} ${report.scanSha256 ?? `${report.title} ${report.cloud}`}`;
    this.all = this.saved();
    this.button = h("button", { type: "button", class: "copy", onclick: () => this.box.showModal() }, icon("list"), this.caption);
    const head = h("tr", {}, ...text.measurementTable.map((name) => h("th", { scope: "col" }, name)), h("td"));
    const close = iconButton("close", text.close, () => this.box.close());
    const download = h("button", { type: "button", class: "copy", onclick: () => this.download() }, icon("download"), text.download);
    this.box.append(
      h("div", { class: "dialog-head" }, h("h2", {}, text.measurements), close),
      h("div", { class: "scrolls", tabindex: 0, role: "region", "aria-label": text.measurements }, h("table", {}, h("thead", {}, head), this.body)),
      h("p", { class: "quiet" }, text.measurementsSaved),
      h("div", { class: "copies" }, download),
    );
    document.body.append(this.box);
    window.addEventListener("storage", ({ key }) => key === this.key && this.show(this.saved())); // of another tab
    this.show(this.all);
  }

  add(measurement: Measurement): void {
    this.all.push(measurement);
    this.changed();
  }

  private saved(): Measurement[] {
    try {
      return JSON.parse(localStorage.getItem(this.key) ?? "[]") as Measurement[];
    } catch {
      return []; // a browser may keep nothing for pages on disk
    }
  }

  private save(): void {
    try {
      localStorage.setItem(this.key, JSON.stringify(this.all));
    } catch {
      // as above: the list then lasts as long as the page
    }
  }

  private changed(): void {
    this.save();
    this.show(this.all);
  }

  private show(all: Measurement[]): void {
    this.all = all;
    this.button.hidden = !this.all.length;
    this.caption.textContent = text.measurementCount(this.all.length);
    this.body.replaceChildren(...this.all.map((measurement, index) => this.row(measurement, index)));
    if (!this.all.length) this.box.close();
  }

  private row(measurement: Measurement, index: number): HTMLElement {
    const { metres, deviation, horizontal, vertical, photos, link } = measurement;
    const note = h("input", { value: measurement.note, "aria-label": text.measurementNote(index + 1) });
    note.addEventListener("change", () => {
      measurement.note = note.value;
      this.save();
    });
    const show = iconButton("search", text.showMeasurement(index + 1), () => {
      this.box.close();
      location.hash = link;
    });
    show.disabled = !photos.every((name) => this.report.photos.some((photo) => photo.name === name));
    const remove = iconButton("close", text.removeMeasurement(index + 1), () => {
      this.all.splice(index, 1);
      this.changed();
    });
    const cells = [text.distance(metres, deviation), text.distance(horizontal, null), text.distance(vertical, null)];
    const from = [...new Set(photos)].join(", ");
    return h("tr", {}, h("td", {}, note), ...[...cells, from].map((cell) => h("td", {}, cell)), h("td", { class: "row-buttons" }, show, remove));
  }

  private download(): void {
    const numbers = (values: number[]) => values.map((value) => value.toFixed(METRES));
    const rows = this.all.map(({ note, metres, deviation, horizontal, vertical, photos, points }) => [
      ...[note, metres.toFixed(METRES), deviation?.toFixed(METRES) ?? "", ...numbers([horizontal, vertical])],
      ...photos.flatMap((name, index) => [name, ...numbers(points[index])]),
    ]);
    saveTable(text.measurementsFile(this.report.title), COLUMNS, rows);
  }
}
