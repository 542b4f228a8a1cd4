/** A dialog that asks what a photo's file does not say: its field of view, about where it was taken, and how exact a pose must be. */
import { h, iconButton } from "./dom";
import type { Plan } from "./plan";
import { text } from "./text";
import type { Report } from "./types";
import type { Options } from "./upload";

const words = text.drop;

export class OptionsDialog {
  private readonly box = h("dialog", { class: "help options", "aria-label": words.options });
  private readonly inputs: HTMLInputElement[] = [];
  private onUse: (told: Options) => void = () => undefined;

  constructor(
    private readonly report: Report,
    private readonly plan: Plan,
  ) {
    const field = (name: string, min: number | null, max: number | null) => {
      const input = h("input", { type: "number", step: "any", name, min, max });
      this.inputs.push(input);
      return h("label", {}, h("span", {}, words.fields[name]), input);
    };
    const form = h(
      "form",
      { method: "dialog", onsubmit: () => this.onUse(Object.fromEntries(this.inputs.map(({ name, value }) => [name, value]))) },
      h("p", { class: "quiet" }, words.optionsLead),
      field("fov", 1, 179),
      field("focal", 1, 1e6),
      field("x", null, null),
      field("y", null, null),
      field("radius", 0.1, 1e4),
      field("accuracy", 0.001, 1e4),
      h("button", { type: "button", class: "copy", onclick: () => this.pick() }, words.pick),
      h("button", { class: "copy main", onclick: () => this.check() }, words.use),
    );
    const close = iconButton("close", text.close, () => this.box.close());
    this.box.append(h("div", { class: "dialog-head" }, h("h2", {}, words.options), close), form);
    document.body.append(this.box);
    plan.canvas.after(h("p", { class: "pick", role: "status" }, words.picking));
  }

  /** Ask, starting with what is known. */
  open(known: Options, onUse: (told: Options) => void): void {
    this.onUse = onUse;
    for (const input of this.inputs) input.value = known[input.name] ?? "";
    this.box.showModal();
  }

  private check(): void {
    const [, , x, y, radius] = this.inputs;
    const isTold = x.value || y.value || radius.value;
    for (const input of [x, y]) input.setCustomValidity(isTold && !input.value ? words.wholePlace : "");
  }

  /** Let a click on the plan fill in the place; Escape gives that up. */
  private pick(): void {
    const { R, origin } = this.report;
    this.box.close();
    document.body.classList.remove("showing-facts", "showing-list");
    document.body.classList.add("picking");
    this.plan.onPick = (place) => {
      this.plan.onPick = null;
      document.body.classList.remove("picking");
      for (const [axis, name] of place ? ["x", "y"].entries() : []) {
        const metres = origin[axis] + R[axis] * place![0] + R[3 + axis] * place![1];
        this.inputs.find((input) => input.name === name)!.value = metres.toFixed(2);
      }
      this.box.showModal();
    };
  }
}
