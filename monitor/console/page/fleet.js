// The overview: the alarms of all, a card for each vehicle.
import { AlarmTable } from "./alarms.js";
import { el, say, sync } from "./dom.js";
import { figure, whyNot } from "./words.js";

/** What is said of a vehicle: the word, and the class that gives it its colour. */
export function stateOf(card) {
  if (!card.live) return ["monitor gone", "gone"];
  const known = { monitoring: "watched", starting: "starting", blind: "blind", degraded: "degraded", stale: "stale" };
  const idle = Object.values(card.watching ?? {});
  if (card.state === "monitoring" && idle.length && idle.every((watch) => watch.why_not === "on_ground")) {
    return ["on the ground", "starting"];
  }
  return [known[card.state] ?? "unknown", card.state];
}

export class FleetPage {
  constructor(app) {
    this.app = app;
    this.vehicle = null;
    this.cards = el("ul", { class: "cards" });
    this.none = el("p", { class: "quiet" });
    this.alarms = new AlarmTable(app, null);
    this.element = el(
      "div",
      {},
      el("h1", { class: "unseen" }, "Fleet"),
      el("h2", {}, "Alarms"),
      this.alarms.element,
      el("h2", {}, "Vehicles"),
      this.cards,
      this.none,
    );
  }

  update(news) {
    const cards = [...this.app.cards.values()];
    say(this.none, cards.length ? "" : "No monitor is heard yet. Start one with “fauio run”, or try “fauio demo”.");
    sync(this.cards, cards, (card) => card.name, makeCard, (element, card) => this.#fill(element, card));
    if (news.alarms) this.alarms.update(this.app.alarms, this.app.more);
  }

  tick() {
    this.alarms.tick();
  }

  #fill(element, card) {
    const { at } = element;
    const [word, kind] = stateOf(card);
    const active = this.app.alarms.filter((alarm) => alarm.vehicle === card.name && alarm.group === "active");
    const count = (severity) => active.filter((alarm) => alarm.severity === severity).length;
    const worst = count("critical") ? "critical" : kind === "blind" ? "blind" : active.length ? "warning" : kind;
    element.dataset.worst = worst;
    say(at.state, word);
    at.state.className = `badge ${kind}`;
    for (const severity of ["critical", "warning"]) {
      at[severity].hidden = !count(severity);
      say(at[severity], `${count(severity)} ${severity}`);
    }
    say(at.mode, card.mode || "");
    say(at.why, active.length ? active[0].message : (card.reasons ?? [])[0] ?? "");
    say(at.figures, figures(card));
    const watching = Object.entries(card.watching ?? {});
    sync(at.watching, watching, ([name]) => name, makeWatch, (item, [name, watch]) => {
      const share = Math.round(100 * (watch.share ?? 0));
      item.meter.value = share;
      item.meter.textContent = `${share} %`;
      say(item.name, name);
      say(item.why, watch.why_not ? whyNot(watch.why_not) : `${share} %`);
    });
  }
}

export function figures(card) {
  if (card.messages_per_s === undefined || card.messages_per_s === null) return "";
  const lost = card.lost_share === null ? "" : ` · ${figure(100 * card.lost_share, 2)} % lost`;
  return `${figure(card.messages_per_s)} messages/s${lost} · ${figure(card.latency_ms, 2)} ms`;
}

function makeCard(card) {
  const at = {
    state: el("span", {}),
    critical: el("span", { class: "badge critical" }),
    warning: el("span", { class: "badge warning" }),
    mode: el("span", { class: "mode" }),
    why: el("p", { class: "why" }),
    figures: el("p", { class: "figures" }),
    watching: el("ul", { class: "watching", "aria-label": "Evidence in the last minute, by observer" }),
  };
  const link = el("a", { href: `#/vehicle/${encodeURIComponent(card.name)}` }, card.name);
  const badges = el("p", { class: "badges" }, at.state, at.critical, at.warning, at.mode);
  const element = el("li", { class: "card" }, el("h2", {}, link), badges, at.why, at.watching, at.figures);
  element.at = at;
  return element;
}

function makeWatch() {
  const name = el("span", { class: "name" });
  const meter = el("meter", { min: "0", max: "100" });
  const why = el("span", { class: "why-not" });
  return Object.assign(el("li", {}, name, meter, why), { name, meter, why });
}
