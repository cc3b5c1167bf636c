// One vehicle: its alarms, estimates against thresholds, residuals, link, track, time line, clips.
import { AlarmTable } from "./alarms.js";
import { EstimateChart, LineChart } from "./chart.js";
import { el, remembered, say } from "./dom.js";
import { figures, stateOf } from "./fleet.js";
import { TrackMap } from "./map.js";
import { Past } from "./past.js";
import { Timeline } from "./timeline.js";
import { dateAndTime } from "./words.js";

const SPANS = [60, 300, 900];
const LEAST_S = 30;
const GPS = /\/gps_(north|east)$/;
const CLIPS_MS = 15000;
const LINK = [
  ["messages_per_s", "Messages", "per s", 1],
  ["lost_share", "Lost", "%", 100],
  ["latency_ms", "From arrival to result", "ms", 1],
  ["delay_s", "Delay of the link", "ms", 1000],
  ["jitter_s", "Jitter", "ms", 1000],
];

export class VehiclePage {
  constructor(app, vehicle) {
    Object.assign(this, { app, vehicle, past: new Past(), charts: [], held: null });
    this.span = Number(remembered("span")) || SPANS[1];
    this.state = el("span", {});
    this.mode = el("span", { class: "mode" });
    this.figures = el("p", { class: "figures" });
    this.reasons = el("ul", { class: "reasons" });
    this.alarms = new AlarmTable(app, vehicle);
    this.timeline = new Timeline();
    this.map = new TrackMap();
    this.estimates = el("div", {});
    this.residuals = el("div", { class: "charts" });
    this.link = el("div", { class: "charts" });
    this.clips = el("section", { hidden: true });
    const more = el("details", { toggle: () => this.#charts() }, el("summary", {}, "Residuals"), this.residuals);
    this.more = more;
    this.element = el(
      "div",
      { class: "vehicle" },
      el("h1", {}, vehicle),
      el("p", { class: "badges" }, this.state, this.mode),
      this.reasons,
      this.figures,
      this.alarms.element,
      this.#tools(),
      el("div", { class: "halves" }, section("Time line", this.timeline.element), section("Track", this.map.element)),
      el("h2", {}, "Estimates"),
      el("p", { class: "legend" }, ...LEGEND.map(([kind, text]) => el("span", { class: `line ${kind}` }, text))),
      this.estimates,
      more,
      section("Link", this.link),
      this.clips,
    );
    this.#card();
    this.#askClips();
  }

  /** A new stream begins with all of the past. */
  begin() {
    this.past = new Past();
    this.#charts();
    this.#askClips();
  }

  close() {
    for (const chart of this.charts) chart.close();
    this.charts = [];
    this.map.close();
  }

  redraw() {
    for (const chart of this.charts) chart.redraw();
    this.map.draw();
  }

  update(news) {
    this.#card();
    if (news.alarms) this.alarms.update(this.app.alarms, 0);
    if (news.past) {
      const first = this.past.status === null && news.past.status;
      if (this.past.add(news.past) || first) this.#charts();
      this.#show();
    }
  }

  tick() {
    this.alarms.tick();
    if (performance.now() - this.askedAt > CLIPS_MS) this.#askClips();
  }

  hold() {
    this.held = this.held === null ? this.past.end : null;
    say(this.holding, this.held === null ? "Hold" : "Go on");
    this.#show();
  }

  #show() {
    const { begin, end: now, spells } = this.past;
    const end = this.held ?? now;
    // at first there is less than was asked for
    const span = [Math.max(end - this.span, Math.min(begin, end - LEAST_S)), end];
    for (const chart of this.charts) chart.update(span, spells.filter((spell) => spell.channel === chart.channel));
    this.timeline.update(this.past, span);
    const ofGps = spells.filter((spell) => GPS.test(spell.channel));
    if (this.past.status) this.map.update(this.past.status, span, ofGps);
  }

  #card() {
    const card = this.app.cards.get(this.vehicle);
    if (!card) {
      say(this.state, "not heard");
      return;
    }
    const [word, kind] = stateOf(card);
    say(this.state, word);
    this.state.className = `badge ${kind}`;
    say(this.mode, card.mode || "");
    say(this.figures, figures(card));
    const reasons = (card.reasons ?? []).join("\n");
    if (this.reasons.dataset.text !== reasons) {
      this.reasons.dataset.text = reasons;
      this.reasons.replaceChildren(...(card.reasons ?? []).map((reason) => el("li", {}, reason)));
    }
    const channels = JSON.stringify(card.channels ?? {});
    if (this.channels !== channels) {
      this.channels = channels;
      this.#charts();
    }
  }

  /** Make the charts anew: other channels, other thresholds, residuals opened or closed. */
  #charts() {
    for (const chart of this.charts) chart.close();
    this.charts = [];
    const known = this.app.cards.get(this.vehicle)?.channels ?? {};
    const add = (chart) => {
      this.charts.push(chart);
      return chart.element;
    };
    const observers = [...this.past.observers];
    this.estimates.replaceChildren(
      ...observers.map(([name, { faults, rows }]) => {
        const charts = faults.map((fault) => {
          const [threshold, unit, factor] = known[name]?.[fault] ?? [null, "", 1];
          const chart = new EstimateChart(rows, fault, { threshold, unit, factor: factor ?? 1 });
          chart.channel = `${name}/${fault}`;
          return add(chart);
        });
        return el("section", {}, el("h3", {}, name), el("div", { class: "charts" }, ...charts));
      }),
    );
    this.residuals.replaceChildren(
      ...(this.more.open ? observers : []).flatMap(([name, { outputs, rows }]) =>
        outputs.map((output) => add(new LineChart(rows, `residual ${output}`, `${name}/${output}`, ""))),
      ),
    );
    const { status } = this.past;
    this.link.replaceChildren(
      ...(status ? LINK : []).map(([name, title, unit, factor]) => add(new LineChart(status, name, title, unit, factor))),
    );
    this.#show();
  }

  #tools() {
    const buttons = SPANS.map((span) =>
      el("button", { type: "button", "aria-pressed": String(span === this.span), click: () => choose(span) }, `${span / 60} min`),
    );
    const choose = (span) => {
      this.span = span;
      remembered("span", String(span));
      buttons.forEach((button, k) => button.setAttribute("aria-pressed", String(SPANS[k] === span)));
      this.#show();
    };
    this.holding = el("button", { type: "button", click: () => this.hold() }, "Hold");
    return el("div", { class: "tools", role: "toolbar", "aria-label": "Time shown" }, ...buttons, this.holding);
  }

  async #askClips() {
    this.askedAt = performance.now();
    if (!this.app.hello.clips) return;
    try {
      const { clips } = await (await fetch("/clips")).json();
      const own = clips.filter((clip) => clip.name.startsWith(`${this.vehicle}-`));
      this.clips.hidden = false;
      this.clips.replaceChildren(
        el("h2", {}, "Clips"),
        own.length
          ? el("ul", { class: "clips" }, ...own.map(clipItem))
          : el("p", { class: "quiet" }, "No alarm has left a clip yet."),
      );
    } catch {
      this.clips.hidden = true;
    }
  }
}

const LEGEND = [
  ["estimate", "estimate, with two standard deviations"],
  ["critical", "estimate during an alarm"],
  ["threshold", "threshold"],
  ["unwatched", "no evidence"],
];

function section(title, content) {
  return el("section", {}, el("h2", {}, title), content);
}

function clipItem(clip) {
  const link = el("a", { href: `/clips/${encodeURIComponent(clip.name)}`, download: clip.name }, clip.name);
  return el("li", {}, link, ` ${(clip.bytes / 1e6).toFixed(1)} MB, ${dateAndTime(clip.time_ns / 1e9)}`);
}
