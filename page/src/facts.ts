/** What was measured of the photo that is opened, in words. */
import { h, icon } from "./dom";
import { length, percent } from "./list";
import { badge, verdictOf } from "./marks";
import type { Model } from "./model";
import { plain, text } from "./text";
import type { Photo, Pose } from "./types";

const PAPER: [number, number] = [0.1, 5]; // m and degrees, where a result does not say them

/** Put a text on the clipboard, also where a page on disk may not ask the browser to. */
async function copy(words: string): Promise<void> {
  try {
    await navigator.clipboard.writeText(words);
  } catch {
    const field = h("textarea", { class: "off-screen", "aria-hidden": "true" });
    field.value = words;
    document.body.append(field);
    field.select();
    document.execCommand("copy");
    field.remove();
  }
}

/** A button that says for a moment that it was done. */
export function doingButton(name: string, label: string, done: string, act: () => unknown): HTMLElement {
  const caption = h("span", {}, label);
  const onclick = () =>
    void Promise.resolve(act()).then(() => {
      caption.textContent = done;
      setTimeout(() => (caption.textContent = label), 1600);
    });
  return h("button", { type: "button", class: "copy", onclick }, icon(name), caption);
}

export function copyButton(name: string, label: string, words: () => string): HTMLElement {
  return doingButton(name, label, text.copied, () => copy(words()));
}

/** A probability in a line. */
const probability = (label: string, value: number, help: string): HTMLElement =>
  h("div", { class: "confidence", title: help }, h("span", {}, label), h("b", {}, percent(value)));

export class Facts {
  constructor(
    private readonly model: Model,
    private readonly box: HTMLElement,
    /** What can be done about a photo; null in a report. */
    private readonly remedies: (photo: Photo) => HTMLElement | null,
  ) {
    model.on("selected alternative", () => this.render());
  }

  private render(): void {
    const { photo, alternative } = this.model;
    if (!photo) return this.box.replaceChildren();
    const pose = alternative === null ? photo.pose : photo.alternatives[alternative].pose;
    this.box.replaceChildren(
      ...[
        this.heading(photo),
        photo.error && this.tells(photo) ? h("p", { class: `error ${photo.status}` }, plain(photo.error)) : null,
        photo.status === "localized" ? null : this.remedies(photo),
        pose ? this.place(photo, pose) : null,
        photo.spread && alternative === null ? this.spread(photo) : null,
        photo.alternatives.length ? this.alternatives(photo) : null,
        photo.evidence ? this.evidence(photo) : null,
        this.about(photo),
        photo.status === "localized" ? this.remedies(photo) : null,
        photo.warnings.length ? section(text.warnings, h("ul", { class: "notes" }, ...photo.warnings.map((note) => h("li", {}, plain(note))))) : null,
      ].filter((part) => part !== null),
    );
  }

  /** Of an unreadable photo the viewer says why, unless something can be done about it here. */
  private tells(photo: Photo): boolean {
    return photo.status !== "unreadable" || this.model.report.service !== undefined;
  }

  private heading(photo: Photo): HTMLElement {
    const meter = h("div", { class: `meter ${photo.status}` }, h("span", { class: "meter-fill" }));
    (meter.firstElementChild as HTMLElement).style.width = `${100 * photo.confidence}%`;
    const hasConfidence = photo.pose && !photo.contradicts.length; // else it is that of what was told
    return h(
      "section",
      { class: "facts-head" },
      h("p", { class: `verdict ${photo.status}` }, badge(photo.status), verdictOf(photo)),
      h("p", { class: "meaning" }, this.meaning(photo)),
      ...photo.contradicts.map((told) => h("p", {}, text.contradictions[told])),
      photo.hint ? h("p", {}, plain(photo.hint)) : null,
      hasConfidence ? probability(text.confidence, photo.confidence, text.confidenceHelp(photo.accuracy ?? PAPER)) : null,
      hasConfidence ? meter : null,
      hasConfidence ? probability(text.place, photo.placeProbability, text.placeHelp) : null,
    );
  }

  private meaning(photo: Photo): string {
    if (photo.contradicts.length) return photo.pose ? text.contradictsPose : text.contradictsAll;
    return photo.pose && !photo.isOnPlan ? text.hopeless : text.statusMeaning[photo.status];
  }

  private place(photo: Photo, pose: Pose): HTMLElement {
    const [x, y, z] = pose.world;
    const rows: [string, string][] = [
      ["x, y, z [m]", `${x.toFixed(3)}, ${y.toFixed(3)}, ${z.toFixed(3)}`],
      [text.angles, pose.angles.map((angle) => `${angle.toFixed(1).replace(/^-0\.0$/, "0.0")}°`).join(", ")],
    ];
    const { storeys } = this.model.report;
    const { storey } = photo;
    if (storey !== null && storeys[storey]) rows.push([text.storey, storeys[storey].name]);
    if (photo.height !== null) rows.push([text.height, `${photo.height.toFixed(2)} m`]);
    if (photo.scan) rows.push([text.inScan, photo.scan]);
    if (photo.beside.length) rows.push([text.helpers, photo.beside.join(", ")]);
    const json = () => JSON.stringify({ R_cam_from_world: chunked(pose.worldRotation), center_world: pose.world });
    const buttons = h(
      "div",
      { class: "copies" },
      copyButton("copy", text.copyPosition, () => pose.world.join(" ")),
      copyButton("copy", text.copyPose, json),
      this.model.hasLinks ? copyButton("link", text.copyLink, () => location.href) : null,
    );
    return section(text.position, table(rows), buttons);
  }

  private spread(photo: Photo): HTMLElement {
    const { largest, deg, direction, ellipse } = photo.spread!;
    const isEven = direction.startsWith("much the same");
    return section(
      text.uncertainty,
      h("p", {}, text.spread(length(largest), Math.max(...deg).toFixed(2))),
      h("p", { class: "quiet" }, isEven ? text.spreadSame : text.spreadMost(direction)),
      h("p", { class: "quiet" }, text.ellipse((2000 * ellipse[0]).toFixed(1), (2000 * ellipse[1]).toFixed(1))),
    );
  }

  private alternatives(photo: Photo): HTMLElement {
    const { model } = this;
    const row = (index: number | null, label: string, probability: number, where: string) =>
      h(
        "button",
        {
          type: "button",
          class: "alternative",
          "aria-pressed": String(model.alternative === index),
          onclick: () => {
            model.alternative = index;
            const storey = index === null ? photo.storey : photo.alternatives[index].storey;
            if (storey !== null && storey !== model.storey) {
              model.storey = storey;
              model.changed("storey");
            }
            model.changed("alternative");
            model.changed("view");
          },
        },
        h("span", {}, label),
        h("span", { class: "quiet" }, where),
        h("b", {}, percent(probability)),
      );
    const away = (pose: Pose) => length(1000 * Math.hypot(...pose.world.map((value, k) => value - photo.pose!.world[k])));
    const rows = photo.alternatives.map((other, index) => row(index, text.alternative(index + 1), other.probability, away(other.pose)));
    const isLikely = (index: number) => photo.alternatives[index].probability >= 0.01;
    const isBeaten = photo.alternatives.some((other) => other.probability > photo.confidence);
    const unlikely = rows.filter((_, index) => !isLikely(index));
    return section(
      text.alternatives,
      isBeaten ? h("p", { class: "quiet" }, text.chosenHelp) : null,
      row(null, isBeaten ? text.chosen : text.best, photo.confidence, ""),
      ...rows.filter((_, index) => isLikely(index)),
      unlikely.length ? this.unlikely(unlikely, model.alternative !== null && !isLikely(model.alternative)) : null,
      photo.probabilityNone === null
        ? null
        : h("p", { class: "alternative none" }, h("span", {}, text.none), h("span", {}), h("b", {}, percent(photo.probabilityNone))),
    );
  }

  private unlikely(rows: HTMLElement[], isOpen: boolean): HTMLElement {
    return h("details", { class: "unlikely", open: isOpen }, h("summary", {}, text.unlikely(rows.length)), ...rows);
  }

  private evidence(photo: Photo): HTMLElement {
    const e = photo.evidence!;
    const bar = (label: string, value: number, kind: string) => {
      const fill = h("span", { class: `bar-fill ${kind}` });
      fill.style.width = `${100 * Math.max(0, Math.min(1, value))}%`;
      return h("div", { class: "bar-row" }, h("span", {}, label), h("span", { class: "bar" }, fill), h("b", {}, percent(value)));
    };
    return section(
      text.score,
      bar(text.explained, e.explained_fraction, "good"),
      bar(text.contradicted, e.contradicted_fraction, "bad"),
      bar(text.seen, e.seen_fraction, ""),
      table([
        [text.score, e.score.toFixed(2)],
        [text.margin, e.margin.toFixed(2)],
      ]),
    );
  }

  private about(photo: Photo): HTMLElement {
    const rows: [string, string][] = [[text.file, photo.name]];
    if (photo.walk !== null) rows.push([text.walk, text.walkAt(photo.walk + 1, photo.time!.toFixed(1))]);
    if (photo.captured) rows.push([text.captured, photo.captured.replace("T", " ")]);
    if (photo.size) rows.push([text.size, `${photo.size[0]} × ${photo.size[1]}`]);
    return section(text.about, table(rows));
  }
}

function chunked(rows: number[]): number[][] {
  return [rows.slice(0, 3), rows.slice(3, 6), rows.slice(6, 9)];
}

export function section(title: string, ...children: (Node | null)[]): HTMLElement {
  return h("section", {}, h("h3", {}, title), ...children);
}

function table(rows: [string, string][]): HTMLElement {
  return h("dl", {}, ...rows.flatMap(([name, value]) => [h("dt", {}, name), h("dd", {}, value)]));
}
