/** The photos listed as a table that spreadsheets read. */
import { h } from "./dom";
import type { Model } from "./model";

const COLUMNS = ["photo", "status", "confidence", "place_probability", "storey", "x", "y", "z", "heading_deg", "pitch_deg", "roll_deg", "std_mm"];

/** Save the photos listed as CSV. */
export function download({ listed, report }: Model): void {
  const rows = listed.map((index) => {
    const { name, status, confidence, placeProbability, storey, pose, spread } = report.photos[index];
    const where = pose ? [...pose.world, ...pose.angles] : Array<string>(6).fill("");
    return [name, status, confidence, placeProbability, storey === null ? "" : report.storeys[storey].name, ...where, spread?.largest ?? ""];
  });
  saveTable(report.title, COLUMNS, rows);
}

/** Save rows under their heads as CSV. */
export function saveTable(name: string, columns: string[], rows: (string | number)[][]): void {
  const text = [columns, ...rows].map((row) => row.map(cell).join(",")).join("\r\n");
  save(`${name}.csv`, `${text}\r\n`, "text/csv");
}

/** Save a text as a file. */
export function save(name: string, text: string, type: string): void {
  const href = URL.createObjectURL(new Blob([text], { type }));
  h("a", { href, download: name }).click();
  setTimeout(() => URL.revokeObjectURL(href), 1000);
}

/** Text in quotes where it needs them; what a spreadsheet would take for a formula comes after an apostrophe. */
function cell(value: string | number): string {
  const text = typeof value === "string" ? value.replace(/^[=+\-@\t\r']/, "'$&") : String(value);
  return /[",\r\n]/.test(text) ? `"${text.replaceAll('"', '""')}"` : text;
}
