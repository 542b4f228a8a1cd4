/** What is printed: the plan of each storey with its photos, numbered, and a table of them. */
import { h, svg } from "./dom";
import { percent } from "./list";
import { shape } from "./marks";
import { ahead, type Model } from "./model";
import { labelOf } from "./plan_painter";
import { text } from "./text";
import type { Photo, Storey } from "./types";

const MARK = 0.14; // m, or more on a large plan
const MANY = 60; // photos, whose marks are smaller

/** Fill the part of the page that only printers see. */
export function fillPrint(model: Model, box: HTMLElement): void {
  const { report } = model;
  const rows = model.listed.map((index) => [index, report.photos[index]] as const);
  box.replaceChildren(
    h("h1", {}, report.title),
    h("p", {}, `${report.cloud}. ${text.shown(rows.length, report.photos.length)}. ${text.madeBy(report.version)}`),
    ...report.storeys.map((storey, index) => figure(storey, rows.filter(([, photo]) => photo.isOnPlan && photo.storey === index))),
    h(
      "table",
      {},
      h("thead", {}, h("tr", {}, h("th", {}, "#"), ...text.table.map((name) => h("th", {}, name)))),
      h("tbody", {}, ...rows.map(([index, photo]) => line(index, photo, report.storeys))),
    ),
  );
}

function figure(storey: Storey, photos: (readonly [number, Photo])[]): HTMLElement {
  const { plan } = storey;
  if (!plan) return h("p", {}, `${storey.name}: ${text.planEmpty}`);
  const [a, b, c, d, e, f] = plan.matrix;
  const corners = [[0, 0], [plan.width, 0], [0, plan.height], [plan.width, plan.height]].map(([u, v]) => [a * u + c * v + e, -(b * u + d * v + f)]);
  const left = Math.min(...corners.map(([x]) => x));
  const top = Math.min(...corners.map(([, y]) => y));
  const width = Math.max(...corners.map(([x]) => x)) - left;
  const height = Math.max(...corners.map(([, y]) => y)) - top;
  const radius = Math.max(MARK, Math.max(width, height) / 110) * (photos.length > MANY ? 0.65 : 1);
  const image = svg("image", { href: plan.file, width: plan.width, height: plan.height, transform: `matrix(${a} ${-b} ${c} ${-d} ${e} ${-f})` });
  const marks = photos.map(([index, photo]) => {
    const [x, y] = photo.pose!.center;
    const { yaw } = ahead(photo);
    const tip = { x2: x + 3 * radius * Math.cos(yaw), y2: -y - 3 * radius * Math.sin(yaw) };
    return svg(
      "g",
      { class: photo.status === "localized" ? "" : "guess" },
      svg("line", { x1: x, y1: -y, ...tip, class: `heading ${photo.status}`, "stroke-width": radius / 2.5 }),
      shape(photo.status, x, -y, radius),
      svg("text", { x: x + 1.3 * radius, y: -y - 1.3 * radius, "font-size": 2 * radius }, String(index + 1)),
    );
  });
  const bar = [1, 2, 5, 10, 20, 50, 100].find((metres) => metres > width / 8) ?? 200;
  const y = top + height - radius;
  const scale = svg(
    "g",
    {},
    svg("line", { x1: left, y1: y, x2: left + bar, y2: y, class: "scale", "stroke-width": radius / 2 }),
    svg("text", { x: left + bar + radius, y: y + 0.7 * radius, "font-size": 2.4 * radius }, `${bar} m`),
  );
  return h(
    "figure",
    {},
    h("figcaption", {}, `${storey.name}, ${text.level(storey.level.toFixed(2))}, ${text.photos(photos.length)}`),
    svg("svg", { viewBox: `${left} ${top} ${width} ${height}`, class: "print-plan" }, image, ...marks, scale),
  );
}

function line(index: number, photo: Photo, storeys: Storey[]): HTMLElement {
  const place = photo.pose
    ? [percent(photo.confidence), storeys[photo.storey ?? 0]?.name ?? "", ...photo.pose.world.map((value) => value.toFixed(3)), photo.pose.angles[0].toFixed(1)]
    : ["", "", "", "", "", ""];
  const cells = [labelOf(photo), text.status[photo.status], ...place, photo.spread ? photo.spread.largest.toFixed(1) : ""];
  return h("tr", {}, h("td", {}, String(index + 1)), ...cells.map((cell) => h("td", {}, cell)));
}
