/** A place for photos: they stand in the list at once, are sent two at a time, and become what was found. */
import { byId, h, icon, iconButton } from "./dom";
import { section } from "./facts";
import { badge, verdictOf } from "./marks";
import type { Model } from "./model";
import { OptionsDialog } from "./options";
import type { Plan } from "./plan";
import { labelOf } from "./plan_painter";
import { save } from "./table";
import { plain, text } from "./text";
import type { Photo } from "./types";
import { asJson, type Found, LOST, type Options, Refusal, REPLACED, send, TOO_LARGE } from "./upload";

const AT_ONCE = 2;
const STEP = 5; // percent
const TRIES = 6; // of a photo that a busy service sends away
const FOV = "65"; // degrees, of most phones
const MOST_TOGETHER = 48; // photos in a request; the service reads 64
const FORM_BYTES = 1000; // about a photo in a request
const NARROW = "(max-width: 860px)";
const ENDING = /\.[A-Za-z0-9]{3,4}( \(\d+\))?$/;
const NONE = ["probabilityNone", "accuracy", "hint", "scan", "captured", "size", "walk", "time", "pose", "storey", "height", "evidence", "spread"];
const words = text.drop;

/** A photo that was dropped; it rests while a busy service is left alone. */
interface Job {
  file: File;
  photo: Photo;
  options: Options;
  /** The photos that are sent with it, it among them. */
  party: Job[];
  state: "queued" | "sent" | "resting" | "done";
  tries: number;
  stop: AbortController;
  refusal?: Refusal;
  result?: Found["result"];
}

export class Drop {
  private jobs: Job[] = [];
  private options: Options = {};
  /** The photo that was opened here, not by a person; and that which is, once all are localized. */
  private opened: Photo | null = null;
  private last: Job | null = null;
  private count = 0;
  private readonly together = h("input", { type: "checkbox", name: "together" });
  private readonly told = h("div", { class: "told", role: "status" });
  /** Of the photos at work, where the list is out of sight. */
  private readonly progress = h("div", { class: "progress" });
  private readonly dialog: OptionsDialog;

  constructor(
    private readonly model: Model,
    plan: Plan,
  ) {
    this.dialog = new OptionsDialog(model.report, plan);
    this.fill();
    this.listen();
    model.on("selected", () => {
      if (model.photo !== this.opened) this.opened = null;
    });
    model.on("list", () => {
      document.body.classList.toggle("no-photos", !model.report.photos.length);
      this.fillProgress();
    });
    byId("plan").after(this.progress);
  }

  private fill(): void {
    const { maxBytes } = this.model.report.service!;
    const chooser = (how: Record<string, string | boolean>) => {
      const input = h("input", { type: "file", accept: "image/*", hidden: true, ...how });
      input.addEventListener("change", () => {
        this.add([...input.files!]);
        input.value = ""; // so that the file may be chosen again
      });
      return input;
    };
    const files = chooser({ multiple: true });
    const camera = chooser({ capture: "environment" });
    const choose = () => files.click();
    const ask = () => this.dialog.open(this.options, (told) => this.use(told));
    const buttons = [
      action("photos", words.choose, choose, "main"),
      action("camera", words.take, () => camera.click(), "touch-only"),
      action("tune", words.options, ask),
    ];
    const isTouched = matchMedia("(pointer: coarse)").matches;
    const box = h(
      "section",
      { class: "drop" },
      h("span", { class: "drop-mark" }, icon("pin")),
      h("h2", {}, words.title),
      h("p", {}, (isTouched ? words.leadOfTouch : words.lead)(words.megabytes(maxBytes))),
      h("div", { class: "copies" }, ...buttons),
      h("label", { class: "spot" }, this.together, h("span", {}, words.together)),
      this.told,
      h("p", { class: "quiet" }, this.keeps ? words.kept : words.notKept),
      files,
      camera,
    );
    byId("filters").before(box);
    const add = iconButton("plus", words.choose, choose);
    add.classList.add("narrow-only", "add");
    byId("actions").prepend(add);
    byId("filters").lastElementChild!.append(iconButton("results", words.export, () => this.export()));
    document.body.append(h("div", { class: "veil", "aria-hidden": "true" }, icon("pin"), words.here));
  }

  /** Take what is told of the photos to come, and show it beside where they are dropped. */
  private use(told: Options): void {
    this.options = told;
    const said = words.toldOf(told);
    const clear = h("button", { type: "button", class: "link", onclick: () => this.use({}) }, words.forget);
    this.told.replaceChildren(...(said ? [h("span", {}, words.toldNext(said)), clear] : []));
    document.body.classList.toggle("tells", Boolean(said));
  }

  private get keeps(): boolean {
    return this.model.report.service!.keepsPhotos;
  }

  private listen(): void {
    const isLost = ({ state, result }: Job) => state !== "done" || (result && !this.keeps);
    window.addEventListener("beforeunload", (event) => this.jobs.some(isLost) && event.preventDefault());
    const veil = (isOver: boolean) => document.body.classList.toggle("dropping", isOver);
    document.addEventListener("dragstart", (event) => event.preventDefault()); // of the page's own pictures
    document.addEventListener("dragover", (event) => {
      event.preventDefault();
      veil(true);
    });
    document.addEventListener("dragleave", (event) => event.relatedTarget === null && veil(false));
    document.addEventListener("drop", (event) => {
      event.preventDefault();
      veil(false);
      this.add([...event.dataTransfer!.files]);
    });
    document.addEventListener("paste", (event) => this.add([...event.clipboardData!.files]));
  }

  private add(files: File[]): void {
    const most = this.model.report.service!.maxBytes;
    let party: Job[] = [];
    for (const file of files) {
      const { options } = this;
      const photo = this.blank(file, isImage(file) ? URL.createObjectURL(file) : null);
      const size = party.reduce((sum, one) => sum + one.file.size + FORM_BYTES, file.size);
      if (!this.together.checked || size > most || party.length >= MOST_TOGETHER) party = [];
      const job: Job = { file, options, photo, party, state: "queued", tries: 0, stop: new AbortController() };
      party.push(job);
      this.jobs.push(job);
      this.model.put(job.photo);
      if (file.size <= most) continue;
      this.refuse(job, new Refusal(TOO_LARGE, words.tooLarge(words.megabytes(file.size), words.megabytes(most))));
    }
    this.next();
  }

  /** A photo of which nothing is known, under a name that no other has. */
  private blank(file: File, thumb: string | null): Photo {
    const isTaken = (wanted: string) => this.model.report.photos.some((photo) => photo.name === wanted);
    let { name } = file;
    for (let k = 2; isTaken(name); k++) name = `${file.name} (${k})`;
    return {
      ...(Object.fromEntries(NONE.map((key) => [key, null])) as unknown as Photo),
      ...{ gap: false, isOnPlan: false, hasPictures: false, confidence: 0, placeProbability: 0, warnings: [], contradicts: [], alternatives: [], beside: [] },
      ...{ name, short: name.replace(ENDING, "$1"), key: `dropped-${this.count++}` },
      ...{ status: "waiting", error: words.queued, thumb },
    };
  }

  private replace(job: Job, more: Partial<Photo>): void {
    const before = job.photo;
    job.photo = { ...before, ...more };
    if (this.opened === before) this.opened = job.photo;
    this.model.put(job.photo, before);
  }

  private fillProgress(): void {
    const atWork = this.jobs.filter(({ state }) => state !== "done");
    this.progress.replaceChildren(...atWork.map(({ photo }) => h("p", {}, badge(photo.status), h("span", {}, `${labelOf(photo)}: ${plain(photo.error ?? "")}`))));
  }

  private next(): void {
    const parties = [...new Set(this.jobs.map(({ party }) => party))];
    const isAtWork = (party: Job[]) => party.some(({ state }) => state === "sent" || state === "resting");
    const isAsked = (party: Job[]) => party.some(({ state }) => state === "queued") && !isAtWork(party);
    const free = AT_ONCE - parties.filter((party) => party.some(({ state }) => state === "sent")).length;
    for (const party of parties.filter(isAsked).slice(0, Math.max(free, 0))) {
      void this.run(party.filter(({ state }) => state === "queued"));
    }
  }

  /** Send photos in one request; of a told lens nothing is said of spheres, which are sent by themselves. */
  private async run(jobs: Job[]): Promise<void> {
    for (const job of jobs) {
      job.state = "sent";
      this.replace(job, { error: words.sending(0) });
    }
    const areSpheres = await Promise.all(jobs.map(isSphere));
    const stop = new AbortController();
    for (const isOne of [false, true]) {
      const own = jobs.filter((job, index) => areSpheres[index] === isOne && this.jobs.includes(job));
      if (!own.length) continue;
      own.forEach((job) => job.stop.signal.addEventListener("abort", () => own.every((one) => one.stop.signal.aborted) && stop.abort()));
      const options = asJson(own[0].options, isOne, own.length > 1);
      const photos = own.map(({ file, photo }): [File, string] => [file, own.length > 1 ? photo.name : file.name]);
      const answers = send(photos, options, stop.signal, (part) => own.forEach((job) => this.tell(job, part)));
      own.forEach((job, index) => void this.take(job, answers[index]));
    }
  }

  private async take(job: Job, answer: Promise<Found>): Promise<void> {
    try {
      const found = await answer;
      if (this.jobs.includes(job)) this.show(job, found);
    } catch (error) {
      if (this.jobs.includes(job)) this.refuse(job, error instanceof Refusal ? error : new Refusal(LOST, String(error)));
    }
    this.next();
  }

  /** Tell how far an upload is, in steps: each makes the list anew. */
  private tell(job: Job, part: number): void {
    const error = part < 1 ? words.sending(STEP * Math.floor((100 * part) / STEP)) : words.sent;
    if (this.jobs.includes(job) && job.photo.error !== error) this.replace(job, { error });
  }

  private show(job: Job, { photo, result, pictures }: Found): void {
    const own = pictures.then((line) => {
      URL.revokeObjectURL(job.photo.thumb ?? ""); // which it had until now
      job.photo.thumb = line.thumb;
      this.model.list();
      return line.pictures;
    });
    own.catch(() => undefined); // the viewer says it
    if (result.cloud_sha256 !== this.model.report.scanSha256) {
      const reload = h("button", { type: "button", class: "link", onclick: () => location.reload() }, words.reload);
      byId("note").replaceChildren(words.replacedNote, reload);
      byId("note").hidden = false;
      throw new Refusal(REPLACED, words.replaced);
    }
    (window.PICCOLO_PHOTOS ??= {})[photo.key] = own;
    const { short, thumb } = job.photo;
    const name = this.keeps ? photo.name : job.photo.name;
    const isOlder = (other: Photo) => other.name === name && !this.jobs.some((one) => one.photo === other);
    this.model.report.photos.filter(isOlder).forEach((older) => this.model.remove(older));
    job.result = result;
    const ofPlace = photo.contradicts.includes("nowhere") ? words.noPlace : photo.contradicts.includes("near") ? words.contradictsPlace : undefined;
    const verdict = hasPlace(job) ? ofPlace : undefined;
    this.replace(job, { ...photo, name, short, thumb, verdict });
    this.finish(job);
  }

  private refuse(job: Job, refusal: Refusal): void {
    job.refusal = refusal;
    if (refusal.seconds !== null && ++job.tries < TRIES) {
      job.state = "resting";
      this.replace(job, { error: words.busy(refusal.seconds) });
      setTimeout(() => job.state === "resting" && this.queue([job]), 1000 * refusal.seconds);
      return;
    }
    const error = refusal.needsField ? words.needsFieldWhy : refusal.message.replace(`${job.file.name}: `, "");
    if (refusal.isUnreadable) this.replace(job, { error, status: "unreadable" });
    else this.replace(job, { error, verdict: refusal.needsField ? words.needsField : (words.verdicts[refusal.status] ?? words.notYet) });
    this.finish(job);
  }

  private finish(job: Job): void {
    job.state = "done";
    byId("announce").textContent = text.opened(labelOf(job.photo), verdictOf(job.photo));
    if (!this.last?.result || job.result) this.last = job;
    this.openLast();
  }

  private openLast(): void {
    if (!this.last || this.jobs.some(({ state }) => state !== "done")) return;
    const { photo } = this.last;
    this.last = null;
    const isFree = this.model.photo === null || this.model.photo === this.opened;
    if (!isFree || this.model.photo === photo) return;
    this.opened = photo;
    this.model.select(this.model.report.photos.indexOf(photo));
  }

  private queue(jobs: Job[]): void {
    for (const job of jobs.filter((one) => this.jobs.includes(one))) { // others were taken off the list meanwhile
      delete window.PICCOLO_PHOTOS?.[job.photo.key]; // its text is large
      job.state = "queued";
      job.refusal = undefined;
      job.result = undefined;
      this.replace(job, { ...this.blank(job.file, job.photo.thumb), verdict: undefined, name: job.photo.name, short: job.photo.short });
    }
    this.next();
  }

  private remove(job: Job): void {
    job.stop.abort();
    job.party.splice(job.party.indexOf(job), 1);
    this.jobs = this.jobs.filter((other) => other !== job);
    delete window.PICCOLO_PHOTOS?.[job.photo.key];
    this.model.remove(job.photo);
    URL.revokeObjectURL(job.photo.thumb ?? "");
    if (this.last === job) this.last = null;
    this.openLast();
  }

  /** What can be done about a photo: advice if it is not localized, and buttons. */
  remedies(photo: Photo): HTMLElement | null {
    const job = this.jobs.find((other) => other.photo === photo);
    if (!job) return null;
    if (matchMedia(NARROW).matches && photo.status !== "localized") document.body.classList.add("showing-facts");
    const { refusal, result, state } = job;
    const isUnsure = result && photo.status !== "localized";
    const known = refusal?.needsField ? { fov: FOV, ...job.options } : job.options;
    const advice = isUnsure ? (photo.hint ? words.lessExact : words.notSure) : refusal && adviceOn(refusal);
    const retry = (options: Options) => {
      for (const one of job.party) {
        one.options = options;
        one.tries = 0;
      }
      this.queue(job.party.filter((one) => one.state === "done"));
    };
    const buttons = h(
      "div",
      { class: "copies" },
      isUnsure && hasPlace(job) ? action("search", words.everywhere, () => retry(this.withoutPlace(job.options)), "main") : null,
      isUnsure || refusal?.needsField ? action("tune", photo.hint ? words.tellExact : words.tell, () => this.dialog.open(known, retry)) : null,
      state === "done" && refusal?.mayPass ? action("again", words.again, () => retry(job.options)) : null,
      action("close", words.remove, () => this.remove(job)),
    );
    if (!advice) return h("section", {}, buttons);
    if (photo.contradicts.length && hasPlace(job)) return section(`${words.everywhere}?`, h("p", {}, words.everywhereHelp), buttons);
    return section(words.remedy, h("p", {}, advice), buttons);
  }

  /** Options without the place, which then is not told of photos to come either. */
  private withoutPlace(options: Options): Options {
    const { x, y } = this.options;
    const isSame = x === options.x && y === options.y;
    const none = { x: "", y: "", radius: "" };
    if (isSame) this.use({ ...this.options, ...none });
    return { ...options, ...none };
  }

  /** Save the results as localize.py writes them, of which tools/report.py makes a report; a form changes quotes in names. */
  private export(): void {
    const lines = this.jobs.filter(({ result }) => result).map(({ file, result }) => JSON.stringify({ ...result, pano: file.name }));
    save("results.jsonl", lines.map((line) => `${line}\n`).join(""), "application/x-ndjson");
  }
}

function action(drawing: string, label: string, onclick: () => void, kind = ""): HTMLElement {
  return h("button", { type: "button", class: `copy ${kind}`, onclick }, icon(drawing), label);
}

function adviceOn({ status, needsField }: Refusal): string {
  return needsField ? words.tellField : (words.remedies[status] ?? words.otherRemedy);
}

function hasPlace({ options: { x, y } }: Job): boolean {
  return Boolean(x && y);
}

function isImage(file: File): boolean {
  return file.type.startsWith("image/");
}

/** True of a photo twice as wide as high, as spheres are; not of one that the browser can't read. */
async function isSphere({ options, file }: Job): Promise<boolean> {
  if (!options.fov && !options.focal) return false; // not worth the reading
  const image = new Image();
  image.src = URL.createObjectURL(file);
  await image.decode().catch(() => undefined);
  URL.revokeObjectURL(image.src);
  return image.naturalWidth > 0 && image.naturalWidth === 2 * image.naturalHeight;
}
