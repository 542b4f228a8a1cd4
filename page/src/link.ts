/** Links to a photo and a view: #photo=name&view=heading,pitch,field&mode=blend,40; and what is measured. */
import type { Spot } from "./measure";
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
  for (const spot of model.spots) parts.push(`at=${numbersOf(spot).join(",")},${encodeURIComponent(model.report.photos[spot.photo].name)}`);
  return `#${parts.join("&")}`;
}

/** A spot as azimuth and elevation in the camera's frame [deg], and its deviation [mrad]. */
function numbersOf({ ray: [x, y, z], angle }: Spot): string[] {
  return [Math.atan2(y, x) * DEGREES, Math.atan2(z, Math.hypot(x, y)) * DEGREES, 1000 * angle].map((value) => value.toFixed(4));
}

function spotOf(words: string, model: Model): Spot | null {
  const [azimuth, elevation, mrad] = words.split(",", 3).map(Number);
  const name = words.split(",").slice(3).join(",");
  const photo = model.report.photos.findIndex((one) => one.name === name);
  if (photo < 0 || !(Math.abs(azimuth) <= 180 && Math.abs(elevation) <= 90 && mrad >= 0 && mrad <= 100)) return null;
  const [a, e] = [azimuth / DEGREES, elevation / DEGREES];
  return { photo, ray: [Math.cos(e) * Math.cos(a), Math.cos(e) * Math.sin(a), Math.sin(e)], angle: mrad / 1000 };
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
  const spots = values.getAll("at").slice(0, 2).map((words) => spotOf(words, model));
  model.spots = spots.filter((spot) => spot !== null);
  model.isMeasuring = model.spots.length > 0;
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
