// The page: what is shown, the header, keys, theme.
import { el, remembered, say } from "./dom.js";
import { FleetPage } from "./fleet.js";
import { HistoryPage } from "./history.js";
import { Stream } from "./stream.js";
import { VehiclePage } from "./vehicle.js";
import { timeOfDay } from "./words.js";

const byId = (id) => document.getElementById(id);

const app = {
  hello: { commands: false, clips: false },
  cards: new Map(),
  alarms: [],
  more: 0,
  counts: { critical: 0, warning: 0 },
  heard: false, // whether the server said anything: until then nothing is known, not even that all is well
  ahead: 0, // milliseconds that the server's clock is ahead of ours
  page: null,

  /** Unix time of the server, nanoseconds. */
  now: () => (Date.now() + app.ahead) * 1e6,

  /** Say in a corner what came of a command. */
  tell(text, well) {
    byId("said").replaceChildren(el("p", { class: well ? "well" : "ill" }, text));
    clearTimeout(app.untold);
    app.untold = setTimeout(() => byId("said").replaceChildren(), 6000);
  },
};

let lostSince = null;
let version = null;
const raised = new Set();

const stream = new Stream({
  hello(hello) {
    // after an update of the server the page is another one
    if (version !== null && version !== hello.version) location.reload();
    version = hello.version;
    const changed = app.hello.commands !== hello.commands;
    app.hello = hello;
    if (changed) route();
    app.page?.begin?.();
  },

  news(news) {
    app.heard = true;
    app.ahead = news.now_ns / 1e6 - Date.now();
    if (news.names) {
      for (const card of news.cards) app.cards.set(card.name, card);
      app.cards = new Map(news.names.filter((name) => app.cards.has(name)).map((name) => [name, app.cards.get(name)]));
    }
    if (news.alarms) {
      app.alarms = news.alarms;
      app.more = news.more;
      app.counts = news.counts;
      announce();
    }
    header();
    app.page?.update(news);
  },

  lost(lost) {
    if (lost) lostSince ??= Date.now() / 1000;
    else lostSince = null;
    byId("lost").hidden = !lost;
    document.body.dataset.lost = lost;
    say(byId("connection"), lost ? "no connection" : "live");
    const since = lost ? timeOfDay(lostSince) : "";
    say(byId("lost"), lost ? `No connection to the console since ${since}. What is shown may be old; trying again.` : "");
  },
});

function header() {
  const blind = [...app.cards.values()].filter((card) => card.live && card.state === "blind").length;
  const { critical, warning } = app.counts;
  const parts = [
    critical && el("span", { class: "badge critical" }, `${critical} critical`),
    warning && el("span", { class: "badge warning" }, `${warning} warning`),
    blind && el("span", { class: "badge blind" }, `${blind} blind`),
  ].filter(Boolean);
  const text = parts.map((part) => part.textContent).join() || `${app.cards.size} watched, no alarm`;
  const summary = byId("summary");
  if (summary.dataset.text !== text) {
    summary.dataset.text = text;
    summary.replaceChildren(...(parts.length ? parts : [text]));
  }
  const title = critical + warning ? `(${critical + warning}) fauio` : "fauio";
  if (document.title !== title) document.title = title;
}

/** Have a screen reader say what is new. */
function announce() {
  const active = app.alarms.filter((alarm) => alarm.group === "active");
  const fresh = active.filter((alarm) => !raised.has(alarm.id));
  raised.clear();
  for (const alarm of active) raised.add(alarm.id);
  if (fresh.length) say(byId("alert"), `${fresh[0].severity}: ${fresh[0].vehicle}, ${fresh[0].message}`);
}

function route() {
  const [, kind, name] = location.hash.split("/");
  app.page?.close?.();
  if (kind === "vehicle" && name) app.page = new VehiclePage(app, decodeURIComponent(name));
  else if (kind === "history") app.page = new HistoryPage(app);
  else app.page = new FleetPage(app);
  byId("main").replaceChildren(app.page.element);
  for (const link of document.querySelectorAll("header nav a")) {
    const here = link.hash === (kind === "history" ? "#/history" : "#/");
    if (here) link.setAttribute("aria-current", "page");
    else link.removeAttribute("aria-current");
  }
  if (app.heard) app.page.update({ alarms: app.alarms });
}

function follow() {
  route();
  stream.follow(app.page.vehicle);
  byId("main").focus({ preventScroll: true });
  scrollTo(0, 0);
}

const THEMES = { auto: "dark", dark: "light", light: "auto" };

function nextTheme() {
  const theme = THEMES[remembered("theme") ?? "auto"] ?? "auto";
  remembered("theme", theme);
  if (theme === "auto") delete document.documentElement.dataset.theme;
  else document.documentElement.dataset.theme = theme;
  showTheme();
  app.page?.redraw?.();
}

function showTheme() {
  say(byId("theme"), `Theme: ${document.documentElement.dataset.theme ?? "auto"}`);
}

function help() {
  const keys = [
    ["f", "fleet"],
    ["h", "history"],
    ["1 … 9", "the vehicle of that number"],
    ["j, k or arrows", "next, previous alarm"],
    ["a, s, c", "acknowledge, shelve, close the alarm that has the focus"],
    ["space", "hold or go on, on a vehicle's page"],
    ["t", "theme"],
    ["?", "this"],
  ];
  const name = el("input", { type: "text", id: "name", maxlength: "60", autocomplete: "username" });
  name.value = remembered("name") ?? "";
  name.addEventListener("input", () => remembered("name", name.value));
  const list = el("dl", {}, ...keys.flatMap(([key, what]) => [el("dt", {}, el("kbd", {}, key)), el("dd", {}, what)]));
  const label = el("label", { for: "name" }, "Your name, for the journal of what you acknowledge");
  const close = el("button", { type: "button", class: "primary", click: () => byId("dialog").close() }, "Close");
  byId("dialog").replaceChildren(el("h2", {}, "Keys"), list, label, name, el("p", { class: "buttons" }, close));
  byId("dialog").showModal();
}

document.addEventListener("keydown", (event) => {
  if (event.ctrlKey || event.metaKey || event.altKey || byId("dialog").open) return;
  if (event.target.closest("input, select, textarea")) return;
  const vehicle = [...app.cards.keys()][Number(event.key) - 1];
  if (event.key === "f" || (event.key === "Escape" && app.page.vehicle)) location.hash = "#/";
  else if (event.key === "h") location.hash = "#/history";
  else if (event.key === "t") nextTheme();
  else if (event.key === "?") help();
  else if (/^[jk]$/.test(event.key)) document.querySelector("table.alarms tbody tr")?.focus();
  else if (/^[1-9]$/.test(event.key) && vehicle) location.hash = `#/vehicle/${encodeURIComponent(vehicle)}`;
  else if (event.key === " " && app.page.hold && !event.target.closest("button, a, summary")) app.page.hold();
  else return;
  event.preventDefault();
});

byId("theme").addEventListener("click", nextTheme);
byId("help").addEventListener("click", help);
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => app.page?.redraw?.());
addEventListener("hashchange", follow);
setInterval(() => app.page?.tick(), 1000);
showTheme();
follow();
