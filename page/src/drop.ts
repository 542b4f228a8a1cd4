/** A place for photos: they stand in the list at once, are sent two at a time, and become what was found. */
import { byId, h, icon, iconButton } from "./dom";
import { section } from "./facts";
import type { Model } from "./model";
import { OptionsDialog } from "./options";
import type { Plan } from "./plan";
import { labelOf } from "./plan_painter";
import { save } from "./table";
import { text } from "./text";
import type { Photo } from "./types";
import { type Found, type Options, Refusal, REPLACED, send, TOO_LARGE } from "./upload";

const AT_ONCE = 2;
const TRIES = 6; // of a photo that a busy service sends away
const THUMB = 256; // px
const NARROW = "(max-width: 860px)";
const words = text.drop;

/** A photo that was dropped. */
interface Job {
  file: File;
  photo: Photo;
  options: Options;
  state: "queued" | "sent" | "resting" | "done";
  tries: number;
  refusal: Refusal | null;
  result: Found["result"] | null;
  isSphere: Promise<boolean>;
  stop: AbortController;
}

export class Drop {
  private jobs: Job[] = [];
  /** Options of the photos that come next. */
  private options: Options = {};
  /** The photo that was opened here, not by a person; and the one that is opened once all are localized. */
  private opened: Photo | null = null;
  private last: Job | null = null;
  private count = 0;
  private previews = Promise.resolve(false); // one after the other: a large photo takes memory
  private readonly dialog: OptionsDialog;
  private readonly optionsLabel = h("span", {}, words.options);

  constructor(
    private readonly model: Model,
    plan: Plan,
  ) {
    this.dialog = new OptionsDialog(model, plan);
    this.fill();
    this.listen();
    const update = () => document.body.classList.toggle("no-photos", !model.report.photos.length);
    model.on("list", update);
    update();
  }

  private fill(): void {
    const input = (attributes: Record<string, string | boolean>) => {
      const made = h("input", { type: "file", accept: "image/*", hidden: true, ...attributes });
      made.addEventListener("change", () => {
        this.add([...made.files!]);
        made.value = ""; // so that the file may be chosen again
      });
      return made;
    };
    const files = input({ multiple: true });
    const camera = input({ capture: "environment" });
    const options = () => this.dialog.open(this.options, "", (told) => this.setOptions(told));
    const box = h(
      "section",
      { class: "drop" },
      h("span", { class: "drop-mark" }, icon("pin")),
      h("h2", {}, words.title),
      h("p", {}, words.lead(words.megabytes(this.model.report.service!.maxBytes))),
      h(
        "div",
        { class: "drop-buttons" },
        action("photos", words.choose, () => files.click(), "main"),
        action("camera", words.take, () => camera.click(), "touch-only"),
        h("button", { type: "button", class: "copy", onclick: options }, icon("tune"), this.optionsLabel),
      ),
      h("p", { class: "quiet" }, words.kept),
      files,
      camera,
    );
    byId("filters").before(box);
    const add = iconButton("plus", words.choose, () => files.click());
    add.classList.add("narrow-only");
    byId("actions").prepend(add);
    byId("filters").querySelector(".shown-row")!.append(iconButton("results", words.export, () => this.export()));
    document.body.append(h("div", { class: "veil", "aria-hidden": "true" }, h("p", {}, icon("pin"), words.here)));
  }

  private listen(): void {
    const isOver = (value: boolean) => document.body.classList.toggle("dropping", value);
    document.addEventListener("dragstart", (event) => event.preventDefault()); // of the page's own pictures
    document.addEventListener("dragover", (event) => {
      event.preventDefault();
      isOver(event.dataTransfer?.types.includes("Files") ?? false);
    });
    document.addEventListener("dragleave", (event) => event.relatedTarget === null && isOver(false));
    document.addEventListener("drop", (event) => {
      event.preventDefault();
      isOver(false);
      this.add([...(event.dataTransfer?.files ?? [])]);
    });
    document.addEventListener("paste", (event) => this.add([...(event.clipboardData?.files ?? [])]));
  }

  private setOptions(options: Options): void {
    this.options = options;
    this.optionsLabel.textContent = Object.keys(options).length ? words.optionsSet : words.options;
  }

  private add(files: File[]): void {
    const { maxBytes } = this.model.report.service!;
    for (const file of files) {
      const photo = this.blank(file.name);
      const job: Job = {
        file,
        photo,
        options: this.options,
        state: "queued",
        tries: 0,
        refusal: null,
        result: null,
        isSphere: Promise.resolve(false),
        stop: new AbortController(),
      };
      this.jobs.push(job);
      this.model.put(photo);
      const isTooLarge = file.size > maxBytes;
      const why = () => words.tooLarge(words.megabytes(file.size), words.megabytes(maxBytes));
      if (isTooLarge) this.refuse(job, new Refusal(TOO_LARGE, why()));
      else job.isSphere = this.previews = this.previews.then(() => this.preview(job));
    }
    this.next();
  }

  /** A photo of which nothing is known, under a name that no other has. */
  private blank(name: string): Photo {
    const isTaken = (wanted: string) => this.model.report.photos.some((photo) => photo.name === wanted);
    let own = name;
    for (let k = 2; isTaken(own); k++) own = `${name} (${k})`;
    const nothing = { probabilityNone: null, scan: null, captured: null, size: null, walk: null, time: null, pose: null, storey: null, height: null };
    const none = { evidence: null, spread: null, thumb: null, gap: false, isOnPlan: false, hasPictures: false, confidence: 0, warnings: [], alternatives: [] };
    const short = own.replace(/\.[A-Za-z0-9]{3,4}( \(\d+\))?$/, "$1");
    return { name: own, short, key: `dropped-${this.count++}`, status: "waiting", error: words.queued, ...nothing, ...none };
  }

  /** Show a small picture of a photo; true if it is a sphere, by its size. */
  private async preview(job: Job): Promise<boolean> {
    try {
      const bitmap = await createImageBitmap(job.file, { resizeWidth: THUMB });
      const canvas = h("canvas", { width: bitmap.width, height: bitmap.height });
      canvas.getContext("2d")!.drawImage(bitmap, 0, 0);
      job.photo.thumb ??= canvas.toDataURL("image/jpeg");
      this.model.list();
      return Math.abs(bitmap.width - 2 * bitmap.height) < 2;
    } catch {
      return false; // a format that browsers do not show: the service may know it
    }
  }

  private replace(job: Job, more: Partial<Photo>): void {
    const before = job.photo;
    job.photo = { ...before, ...more };
    if (this.opened === before) this.opened = job.photo;
    this.model.put(job.photo, before);
  }

  private next(): void {
    const free = AT_ONCE - this.jobs.filter(({ state }) => state === "sent").length;
    for (const job of this.jobs.filter(({ state }) => state === "queued").slice(0, free)) void this.run(job);
  }

  private async run(job: Job): Promise<void> {
    job.state = "sent";
    this.replace(job, { status: "waiting", error: words.sent });
    try {
      const { fov, focal } = job.options;
      const isSphere = fov || focal ? await job.isSphere : false;
      this.found(job, await send(job.file, job.options, isSphere, job.stop.signal));
    } catch (error) {
      if (this.jobs.includes(job)) this.refuse(job, error as Refusal);
    }
    this.next();
  }

  private found(job: Job, { photo, result, pictures }: Found): void {
    if (!this.jobs.includes(job)) return;
    if (result.cloud_sha256 && result.cloud_sha256 !== this.model.report.scanSha256) {
      this.sayReplaced();
      throw new Refusal(REPLACED, words.replaced);
    }
    const { name, short, thumb } = job.photo;
    job.result = result;
    job.refusal = null;
    if (pictures) {
      const own = pictures.then((line) => line.pictures);
      own.catch(() => undefined); // the viewer says it
      (window.PICCOLO_PHOTOS ??= {})[photo.key] = own;
      pictures.then(
        (line) => {
          job.photo.thumb = line.thumb;
          this.model.list();
        },
        () => undefined,
      );
    }
    this.replace(job, { ...photo, name, short, thumb });
    this.finish(job);
  }

  private refuse(job: Job, refusal: Refusal): void {
    job.refusal = refusal;
    if (refusal.seconds !== null && ++job.tries < TRIES) {
      job.state = "resting";
      this.replace(job, { error: words.busy(refusal.seconds) });
      setTimeout(() => job.state === "resting" && this.again(job), 1000 * refusal.seconds);
      return;
    }
    this.replace(job, { status: refusal.mayPass ? "waiting" : "unreadable", error: refusal.message });
    this.finish(job);
  }

  private finish(job: Job): void {
    job.state = "done";
    byId("announce").textContent = text.opened(labelOf(job.photo), text.status[job.photo.status]);
    if (!this.last?.result || job.result) this.last = job;
    if (this.jobs.some(({ state }) => state !== "done")) return;
    const { photo } = this.last;
    this.last = null;
    const isFree = this.model.photo === null || this.model.photo === this.opened;
    if (!isFree || this.model.photo === photo) return;
    this.opened = photo;
    this.model.select(this.model.report.photos.indexOf(photo));
  }

  private again(job: Job): void {
    job.state = "queued";
    this.replace(job, { status: "waiting", error: words.queued });
    this.next();
  }

  private remove(job: Job): void {
    job.stop.abort();
    this.jobs = this.jobs.filter((other) => other !== job);
    delete window.PICCOLO_PHOTOS?.[job.photo.key];
    this.model.remove(job.photo);
    this.next();
  }

  /** What can be done about a photo: the reason that it is not localized, and buttons. */
  remedies(photo: Photo): HTMLElement | null {
    const job = this.jobs.find((other) => other.photo === photo);
    if (!job) return null;
    if (matchMedia(NARROW).matches && photo.status !== "localized") document.body.classList.add("showing-facts");
    const { refusal, state } = job;
    const isUnsure = photo.status === "ambiguous" || photo.status === "not_localized";
    const advice = isUnsure ? words.notSure : refusal && (words.remedies[refusal.status] ?? words.otherRemedy);
    const tell = () =>
      this.dialog.open(job.options, labelOf(photo), (told) => {
        job.options = told;
        this.restart(job);
      });
    return section(
      words.remedy,
      advice ? h("p", {}, advice) : null,
      h(
        "div",
        { class: "copies" },
        isUnsure ? action("tune", words.tell, tell) : null,
        state === "done" && refusal?.mayPass ? action("again", words.again, () => this.restart(job)) : null,
        action("close", words.remove, () => this.remove(job)),
      ),
    );
  }

  private restart(job: Job): void {
    job.tries = 0;
    this.again(job);
  }

  private sayReplaced(): void {
    const reload = h("button", { type: "button", class: "link", onclick: () => location.reload() }, words.reload);
    byId("note").replaceChildren(words.replacedNote, " ", reload);
    byId("note").hidden = false;
  }

  /** Save the results as localize.py writes them, of which tools/report.py makes a report. */
  private export(): void {
    const results = this.jobs.flatMap(({ result }) => (result ? [`${JSON.stringify(result)}\n`] : []));
    save("results.jsonl", results.join(""), "application/x-ndjson");
  }
}

function action(drawing: string, label: string, onclick: () => void, kind = ""): HTMLElement {
  return h("button", { type: "button", class: `copy ${kind}`, onclick }, icon(drawing), label);
}
