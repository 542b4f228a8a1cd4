/** The page of a report: puts its parts together. */
import { byId, h, icon, iconButton } from "./dom";
import { Drop } from "./drop";
import { Facts } from "./facts";
import { follow, linkOf } from "./link";
import { List } from "./list";
import { badge, verdictOf } from "./marks";
import { type Mode, Model, type Sort } from "./model";
import { Plan } from "./plan";
import { labelOf } from "./plan_painter";
import { fillPrint } from "./print";
import { download } from "./table";
import { text } from "./text";
import { STATUSES, type Report, type Status } from "./types";
import { Viewer } from "./viewer";

const MODES: Mode[] = ["photo", "blend", "split", "scan"];
const THEME = "piccolo-theme";

function reportOf(): Report {
  const within = document.getElementById("report");
  return within ? (JSON.parse(within.textContent!) as Report) : window.PICCOLO_REPORT!;
}

const model = new Model(reportOf());
const root = document.documentElement;
const plan = new Plan(model, byId<HTMLCanvasElement>("plan"), showScale);

function countOf(status: Status): number {
  return model.report.photos.filter((photo) => photo.status === status).length;
}

function fillCounts(): void {
  const count = (status: Status) => h("span", { class: `count ${status}` }, badge(status), String(countOf(status)), h("span", { class: "count-word" }, text.status[status].toLowerCase()));
  byId("counts").replaceChildren(...STATUSES.filter(countOf).map(count));
}

function fillHead(): void {
  const { report } = model;
  document.title = report.title;
  byId("title").textContent = report.title;
  byId("skip").textContent = text.skip;
  model.on("list", fillCounts);
  byId("note").textContent = text.note(report.note);
  byId("note").hidden = !report.note;
  const theme = iconButton(isDark() ? "sun" : "moon", isDark() ? text.light : text.dark, () => {
    setTheme(isDark() ? "light" : "dark");
    theme.replaceChildren(icon(isDark() ? "sun" : "moon"));
    for (const name of ["aria-label", "title"]) theme.setAttribute(name, isDark() ? text.light : text.dark);
  });
  const list = iconButton("list", text.showList, () => toggleDrawer("showing-list"));
  list.classList.add("narrow-only");
  const facts = iconButton("info", text.showFacts, () => toggleDrawer("showing-facts"));
  facts.classList.add("narrow-only", "viewing-only");
  byId("actions").append(list, facts, iconButton("print", text.print, print), iconButton("help", text.help, () => byId<HTMLDialogElement>("help").showModal()), theme);
}

function toggleDrawer(name: string): void {
  const isOn = document.body.classList.toggle(name);
  const other = name === "showing-list" ? "showing-facts" : "showing-list";
  if (isOn) document.body.classList.remove(other);
}

function isDark(): boolean {
  return root.dataset.theme ? root.dataset.theme === "dark" : matchMedia("(prefers-color-scheme: dark)").matches;
}

function setTheme(theme: string): void {
  root.dataset.theme = theme;
  try {
    localStorage.setItem(THEME, theme);
  } catch {
    // a browser may keep nothing for pages on disk: the theme then lasts as long as the page
  }
  plan.themed();
}

function savedTheme(): void {
  try {
    const theme = localStorage.getItem(THEME);
    if (theme === "light" || theme === "dark") root.dataset.theme = theme;
  } catch {
    // as above
  }
}

function fillChip(chip: HTMLElement, status: Status): void {
  const count = countOf(status);
  const label = text.filterStatus(text.status[status], count);
  chip.hidden = !count;
  chip.setAttribute("aria-pressed", String(model.statuses.has(status)));
  for (const name of ["aria-label", "title"]) chip.setAttribute(name, label);
  chip.replaceChildren(badge(status), String(count));
}

function fillFilters(): void {
  const { report } = model;
  const relist = () => model.list();
  const search = h("input", { type: "search", id: "search", placeholder: text.search, "aria-label": text.search, autocomplete: "off" });
  search.addEventListener("input", () => {
    model.search = search.value;
    relist();
  });
  const chips = STATUSES.map((status) => {
    const chip = h("button", { type: "button", class: `chip ${status}` });
    chip.addEventListener("click", () => {
      if (model.statuses.has(status)) model.statuses.delete(status);
      else model.statuses.add(status);
      relist();
    });
    return chip;
  });
  const storey = h("select", { "aria-label": text.storey }, h("option", { value: "" }, text.allStoreys), ...report.storeys.map((one, index) => h("option", { value: index }, one.name)));
  storey.addEventListener("change", () => {
    model.onlyStorey = storey.value === "" ? null : Number(storey.value);
    if (model.onlyStorey !== null) showStorey(model.onlyStorey);
    relist();
  });
  storey.hidden = report.storeys.length < 2;
  const sorts = Object.entries(text.sorts).filter(([value]) => value !== "taken" || report.service || report.photos.some((photo) => photo.captured));
  const sort = h("select", { "aria-label": text.sort }, ...sorts.map(([value, label]) => h("option", { value }, label)));
  sort.addEventListener("change", () => {
    model.sort = sort.value as Sort;
    relist();
  });
  const least = h("input", { type: "range", min: 0, max: 100, value: 0, "aria-label": text.minConfidence });
  const shownLeast = h("output", {}, "0 %");
  least.addEventListener("input", () => {
    model.minConfidence = Number(least.value) / 100;
    shownLeast.textContent = `${least.value} %`;
    relist();
  });
  const clear = h("button", { type: "button", class: "link" }, text.clear);
  clear.addEventListener("click", () => {
    search.value = model.search = storey.value = "";
    model.onlyStorey = null;
    least.value = "0";
    shownLeast.textContent = "0 %";
    model.minConfidence = 0;
    for (const status of STATUSES) model.statuses.add(status);
    relist();
  });
  const shown = h("p", { class: "shown", role: "status" });
  model.on("list", () => {
    shown.textContent = text.shown(model.listed.length, report.photos.length);
    clear.hidden = model.listed.length === report.photos.length;
    chips.forEach((chip, index) => fillChip(chip, STATUSES[index]));
  });
  byId("filters").append(
    h("div", { class: "search" }, icon("search"), search),
    h("div", { class: "chips", role: "group", "aria-label": text.filters }, ...chips),
    h("div", { class: "selects" }, storey, sort),
    h("label", { class: "least" }, h("span", {}, text.minConfidence), least, shownLeast),
    h("div", { class: "shown-row" }, shown, clear, iconButton("download", text.download, () => download(model))),
  );
}

function showStorey(index: number): void {
  model.storey = index;
  model.changed("storey");
}

function fillPlan(): void {
  const { report } = model;
  byId("plan").setAttribute("aria-label", text.planHelp);
  const buttons = report.storeys
    .map((storey, index) =>
      h("button", { type: "button", "data-storey": index, onclick: () => showStorey(index) }, h("b", {}, storey.name), h("span", {}, text.level(storey.level.toFixed(2)))),
    )
    .reverse();
  byId("storeys").append(...buttons);
  byId("storeys").setAttribute("aria-label", text.storey);
  byId("storeys").hidden = buttons.length < 2;
  const mark = () => {
    for (const button of buttons) button.setAttribute("aria-pressed", String(Number(button.dataset.storey) === model.storey));
    byId("plan-empty").hidden = Boolean(report.storeys[model.storey]?.plan);
  };
  model.on("storey selected", mark);
  mark();
  byId("plan-empty").textContent = text.planEmpty;
  byId("zooms").append(
    iconButton("plus", text.zoomIn, () => plan.zoom(1.4)),
    iconButton("minus", text.zoomOut, () => plan.zoom(1 / 1.4)),
    iconButton("fit", text.fit, () => plan.fit()),
  );
  byId("swap").append(icon("expand"));
  for (const name of ["aria-label", "title"]) byId("swap").setAttribute(name, text.enlargePlan);
  byId("swap").addEventListener("click", () => document.body.classList.toggle("large-plan"));
  if (report.north) {
    const [x, y] = report.north;
    const needle = byId("north");
    needle.hidden = false;
    needle.title = text.north;
    needle.style.transform = `rotate(${(Math.atan2(x, y) * 180) / Math.PI}deg)`;
  }
}

/** The bar that tells the plan's scale. */
function showScale(scale: number): void {
  const metres = [0.01, 0.05, 0.1, 0.5, 1, 2, 5, 10, 20, 50, 100, 200, 500, 1000].find((length) => length * scale >= 56) ?? 2000;
  byId("scale-bar").style.width = `${metres * scale}px`;
  byId("scale-text").textContent = metres < 1 ? `${metres * 100} cm` : `${metres} m`;
}

function fillViewerHead(): void {
  const close = iconButton("back", text.back, () => model.select(null));
  const previous = iconButton("up", text.previous, () => model.step(-1));
  const next = iconButton("up", text.next, () => model.step(1));
  next.classList.add("downwards");
  const name = h("h2", { id: "photo-name" });
  const place = h("span", { class: "place" });
  byId("viewer-head").append(close, name, place, previous, next);
  model.on("selected list", () => {
    const { photo } = model;
    const [at, count] = model.place;
    name.replaceChildren(...(photo ? [badge(photo.status), labelOf(photo)] : []));
    name.className = photo?.status ?? "";
    place.textContent = at < 0 ? "" : text.of(at + 1, count);
    previous.disabled = at <= 0;
    next.disabled = at < 0 || at >= count - 1;
  });
}

function fillHelp(): void {
  const dialog = byId<HTMLDialogElement>("help");
  const close = iconButton("close", text.close, () => dialog.close());
  const keys = text.keys.flatMap(([key, meaning]) => [h("dt", {}, h("kbd", {}, key)), h("dd", {}, meaning)]);
  dialog.setAttribute("aria-label", text.help);
  dialog.append(h("div", { class: "dialog-head" }, h("h2", {}, text.help), close), h("dl", {}, ...keys), h("p", { class: "quiet" }, text.madeBy(model.report.version)));
}

function print(): void {
  fillPrint(model, byId("print"));
  const images = [...byId("print").querySelectorAll("image")].map((image) => {
    const loaded = new Image();
    loaded.src = image.getAttribute("href")!;
    return loaded.decode().catch(() => undefined);
  });
  void Promise.all(images).then(() => window.print());
}

function onKey(event: KeyboardEvent): void {
  const target = event.target as HTMLElement;
  const isTyping = target.matches("input, select, textarea") || document.querySelector("dialog[open]");
  if (event.key === "Escape" && plan.onPick && !document.querySelector("dialog[open]")) {
    event.preventDefault(); // it would close the dialog that opens
    return plan.onPick(null);
  }
  if (event.key === "Escape" && model.isMeasuring && !document.querySelector("dialog[open]")) return viewer.toggleMeasuring();
  if (event.key === "Escape" && model.selected !== null && !document.querySelector("dialog[open]")) {
    if (document.body.classList.contains("showing-list") || document.body.classList.contains("showing-facts")) {
      document.body.classList.remove("showing-list", "showing-facts");
    } else model.select(null);
    return;
  }
  if (isTyping || event.ctrlKey || event.metaKey || event.altKey) return;
  const actions: Record<string, () => void> = {
    n: () => model.step(1),
    p: () => model.step(-1),
    PageDown: () => model.step(1),
    PageUp: () => model.step(-1),
    d: () => viewer.toggleDifferences(),
    m: () => viewer.toggleMeasuring(),
    "/": () => byId("search").focus(),
    "?": () => byId<HTMLDialogElement>("help").showModal(),
  };
  MODES.forEach((mode, index) => (actions[String(index + 1)] = () => viewer.setMode(mode)));
  const action = actions[event.key];
  if (!action) return;
  event.preventDefault();
  action();
}

/** Keep the address in step with what is shown: a photo is a page of its own for Back, a turn of the head is not. */
function keepAddress(): void {
  let late = 0;
  const set = (isNew: boolean) => {
    const link = linkOf(model) || "#";
    if (link === (location.hash || "#")) return;
    isOurs = true;
    try {
      if (isNew) history.pushState(null, "", link);
      else history.replaceState(null, "", link);
    } catch {
      // browsers bound how often; the next one counts
    }
    isOurs = false;
  };
  let isOurs = false;
  model.on("selected", () => {
    if (!isFollowing) set(true);
  });
  model.on("view mode alternative measure", () => {
    clearTimeout(late);
    late = window.setTimeout(() => set(false), 250);
  });
  const go = () => {
    if (isOurs) return;
    isFollowing = true;
    follow(model, location.hash);
    isFollowing = false;
  };
  let isFollowing = false;
  window.addEventListener("popstate", go);
  if (location.hash.length > 1) go();
}

function onSelected(): void {
  const { photo } = model;
  const wasViewing = document.body.classList.contains("viewing");
  document.body.classList.toggle("viewing", photo !== null);
  document.body.classList.remove("showing-list");
  if (!photo) {
    document.body.classList.remove("large-plan", "showing-facts");
    if (wasViewing) byId("plan").focus();
    return;
  }
  byId("announce").textContent = text.opened(labelOf(photo), verdictOf(photo));
  if (wasViewing) plan.reveal(photo);
}

savedTheme();
fillHead();
fillFilters();
fillPlan();
byId("list").setAttribute("aria-label", text.list);
byId("facts").setAttribute("aria-label", text.details);
const list = new List(model, byId("list"));
const viewer = new Viewer(model, byId("viewer"));
const drop = model.report.service ? new Drop(model, plan) : null;
const facts = new Facts(model, byId("facts"), (photo) => drop?.remedies(photo) ?? null);
fillViewerHead();
fillHelp();
model.on("selected", onSelected);
keepAddress();
model.list();
document.addEventListener("keydown", onKey);
window.addEventListener("beforeprint", () => fillPrint(model, byId("print")));
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => plan.themed());
root.dataset.ready = String(Boolean(list && facts));
