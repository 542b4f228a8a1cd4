/** A dialog that asks what a photo's file does not say: its field of view, and about where it was taken. */
import { h, iconButton } from "./dom";
import type { Model } from "./model";
import type { Plan } from "./plan";
import { text } from "./text";
import type { Options } from "./upload";

const words = text.drop;
const NAMES = ["fov", "focal", "x", "y", "radius"] as const;
const RADIUS = 5; // m, unless another is told

export class OptionsDialog {
  private readonly box = h("dialog", { class: "help options", "aria-label": words.optionsTitle });
  private readonly fields: Record<(typeof NAMES)[number], HTMLInputElement>;
  private readonly about = h("p", { class: "quiet" });
  private onUse: (told: Options) => void = () => undefined;

  constructor(
    private readonly model: Model,
    private readonly plan: Plan,
  ) {
    const [fov, focal, x, y, radius] = NAMES.map((name) => h("input", { type: "number", step: "any", id: `option-${name}` }));
    this.fields = { fov, focal, x, y, radius };
    for (const [field, least, most] of [[fov, 1, 179], [focal, 1, 1e6], [radius, 0.1, 1e4]] as const) {
      field.min = String(least);
      field.max = String(most);
    }
    fov.addEventListener("input", () => (focal.value = "")); // one tells the other
    focal.addEventListener("input", () => (fov.value = ""));
    const row = (name: (typeof NAMES)[number]) => h("label", {}, h("span", {}, words[name]), this.fields[name]);
    const form = h(
      "form",
      { method: "dialog", onsubmit: () => this.onUse(this.told()) },
      this.about,
      h("fieldset", {}, h("legend", {}, words.lens), row("fov"), row("focal")),
      h(
        "fieldset",
        {},
        h("legend", {}, words.place),
        row("x"),
        row("y"),
        row("radius"),
        h("button", { type: "button", class: "copy", onclick: () => this.pick() }, words.pick),
      ),
      h("button", { class: "copy main" }, words.use),
    );
    const close = iconButton("close", text.close, () => this.box.close());
    this.box.append(h("div", { class: "dialog-head" }, h("h2", {}, words.optionsTitle), close), form);
    document.body.append(this.box);
  }

  /** Ask, starting with what is known; `name` is of the photo, empty for those that come. */
  open(known: Options, name: string, onUse: (told: Options) => void): void {
    this.onUse = onUse;
    this.about.textContent = words.optionsFor(name);
    for (const key of NAMES) this.fields[key].value = String(known[key] ?? "");
    this.box.showModal();
  }

  private told(): Options {
    const given = NAMES.filter((name) => this.fields[name].value !== "");
    return Object.fromEntries(given.map((name) => [name, Number(this.fields[name].value)]));
  }

  /** Let a click on the plan fill in the place. */
  private pick(): void {
    const { plan, model } = this;
    const hint = h("p", { class: "pick", role: "status" }, words.picking);
    const stop = () => {
      plan.onPick = null;
      hint.remove();
      document.removeEventListener("keydown", onKey, true);
      document.body.classList.remove("large-plan");
      this.box.showModal();
    };
    const onKey = (event: KeyboardEvent) => {
      if (event.key !== "Escape") return;
      event.stopPropagation();
      stop();
    };
    plan.onPick = (x, y) => {
      const { R, origin } = model.report;
      const [worldX, worldY] = [0, 1].map((axis) => origin[axis] + R[axis] * x + R[3 + axis] * y);
      this.fields.x.value = worldX.toFixed(2);
      this.fields.y.value = worldY.toFixed(2);
      this.fields.radius.value ||= String(RADIUS);
      stop();
    };
    this.box.close();
    document.body.classList.toggle("large-plan", model.photo !== null);
    plan.canvas.parentElement!.append(hint);
    document.addEventListener("keydown", onKey, true);
    plan.canvas.focus();
  }
}
