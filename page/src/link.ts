/** Links to a photo and a view: #photo=name&view=heading,pitch,field&mode=blend,40. */
import type { Mode, Model, View } from "./model";

const DEGREES = 180 / Math.PI;
const MODES: Mode[] = ["photo", "blend", "split", "scan"];

/** The part of an address behind # that leads to what is shown. */
export function linkOf(model: Model): string {
  const { photo, view, mode, amount, alternative, showsDifferences } = model;
  if (!photo) return "";
  const heading = (((90 - view.yaw * DEGREES) % 360) + 360) % 360;
  const numbers = [heading, view.pitch * DEGREES, view.fov * DEGREES].map((value) => value.toFixed(1));
  const parts = [`photo=${encodeURIComponent(photo.name)}`, `view=${numbers.join(",")}`];
  if (mode !== "photo") parts.push(`mode=${mode},${Math.round(100 * amount)}`);
  if (alternative !== null) parts.push(`alternative=${alternative + 1}`);
  if (showsDifferences) parts.push("differences=1");
  return `#${parts.join("&")}`;
}

/** Show what an address leads to; what it does not say stays as it is. */
export function follow(model: Model, hash: string): void {
  const values = new URLSearchParams(hash.replace(/^#/, ""));
  const name = values.get("photo");
  const found = model.report.photos.findIndex((photo) => photo.name === name);
  const [mode, amount] = (values.get("mode") ?? "").split(",");
  if (MODES.includes(mode as Mode)) {
    model.mode = mode as Mode;
    const part = Number(amount);
    if (amount && part >= 0 && part <= 100) model.amount = part / 100;
  }
  model.showsDifferences = values.get("differences") === "1";
  if (found < 0) return model.select(null);
  model.select(found, viewOf(values.get("view")));
  const alternative = Number(values.get("alternative")) - 1;
  if (model.photo!.alternatives[alternative]) {
    model.alternative = alternative;
    model.changed("alternative");
  }
  model.changed("mode");
}

function viewOf(text: string | null): View | null {
  const [heading, pitch, field] = (text ?? "").split(",").map(Number);
  if (![heading, pitch, field].every(Number.isFinite)) return null;
  return { yaw: (90 - heading) / DEGREES, pitch: pitch / DEGREES, fov: field / DEGREES };
}
