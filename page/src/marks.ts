/** A status as a colour and a shape: circle, diamond, triangle, square, hourglass. The same in list, plan and print. */
import { svg } from "./dom";
import { text } from "./text";
import type { Photo, Status } from "./types";

/** Corners on a circle of radius 1, clockwise from the top; none is a circle. */
const CORNERS: Record<Status, [number, number][]> = {
  localized: [],
  ambiguous: [[0, -1.2], [1.2, 0], [0, 1.2], [-1.2, 0]],
  not_localized: [[0, -1.15], [1.1, 0.85], [-1.1, 0.85]],
  unreadable: [[-0.85, -0.85], [0.85, -0.85], [0.85, 0.85], [-0.85, 0.85]],
  waiting: [[-0.9, -1.1], [0.9, -1.1], [-0.9, 1.1], [0.9, 1.1]],
};

/** Trace the shape of a status around (x, y). */
export function trace(context: CanvasRenderingContext2D, status: Status, x: number, y: number, radius: number): void {
  const corners = CORNERS[status];
  context.beginPath();
  if (!corners.length) context.arc(x, y, radius, 0, 2 * Math.PI);
  for (const [dx, dy] of corners) context.lineTo(x + radius * dx, y + radius * dy);
  context.closePath();
}

/** The shape as a drawing, whose class gives its colour. */
export function shape(status: Status, x = 0, y = 0, radius = 1): SVGElement {
  const corners = CORNERS[status];
  if (!corners.length) return svg("circle", { cx: x, cy: y, r: radius, class: `mark ${status}` });
  const points = corners.map(([dx, dy]) => `${x + radius * dx},${y + radius * dy}`).join(" ");
  return svg("polygon", { points, class: `mark ${status}` });
}

/** What is said first of a photo. */
export function verdictOf({ verdict, contradicts, status }: Photo): string {
  return verdict ?? (contradicts.length ? text.contradicts : text.status[status]);
}

/** The shape for lines of text. */
export function badge(status: Status): SVGElement {
  return svg("svg", { viewBox: "-1.4 -1.4 2.8 2.8", class: "badge", "aria-hidden": "true" }, shape(status));
}
