// Past events of all monitors, from their journals.
import { el } from "./dom.js";
import { dateAndTime } from "./words.js";

export class HistoryPage {
  constructor(app) {
    this.app = app;
    this.vehicle = null;
    this.said = el("p", { class: "quiet" }, "asking the monitors …");
    this.rows = el("tbody");
    const titles = ["Time", "Vehicle", "Channel", "Event", "Severity", "Size", "What", ""];
    const head = el("thead", {}, el("tr", {}, ...titles.map((title) => el("th", { scope: "col" }, title))));
    this.element = el(
      "div",
      {},
      el("h1", {}, "History"),
      el("p", {}, el("button", { type: "button", click: () => this.ask() }, "Ask again")),
      this.said,
      el("div", { class: "wide" }, el("table", { class: "history" }, head, this.rows)),
    );
    this.ask();
  }

  update() {}

  tick() {}

  async ask() {
    try {
      const [events, clips] = await Promise.all([fetch("/history"), fetch("/clips")].map(async (one) => (await one).json()));
      if (events.error) throw new Error(events.error);
      const names = new Set((clips.clips ?? []).map((clip) => clip.name));
      this.rows.replaceChildren(...events.events.map((event) => row(event, names)));
      const shown = events.events.length;
      this.said.textContent = shown ? `the newest ${shown} of ${events.all} events` : "No alarm was ever raised.";
    } catch (error) {
      this.said.textContent = `No answer: ${error.message}`;
    }
  }
}

function row(event, clips) {
  const cells = {
    Time: dateAndTime(event.time_ns / 1e9),
    Vehicle: event.vehicle,
    Channel: `${event.observer}/${event.channel}`,
    Event: event.state,
    Severity: event.severity,
    Size: event.display ?? "",
    What: event.message,
  };
  const clip = `${event.vehicle}-${event.id}.mcap`;
  const link = clips.has(clip) ? el("a", { href: `/clips/${encodeURIComponent(clip)}`, download: clip }, "clip") : "";
  return el(
    "tr",
    { "data-severity": event.severity, "data-state": event.state },
    ...Object.entries(cells).map(([title, text]) => el("td", { "data-title": title }, text)),
    el("td", {}, link),
  );
}
