// Alarms, flight modes and what the autopilot said, on one time line.
import { el, say, sync } from "./dom.js";
import { timeOfDay } from "./words.js";

const LOUD = 4; // MAV_SEVERITY_WARNING: this and more urgent

export class Timeline {
  constructor() {
    this.lanes = { alarms: el("div", { class: "lane alarms" }), modes: el("div", { class: "lane" }), texts: el("div", { class: "lane texts" }) };
    const named = Object.entries({ Alarms: "alarms", Modes: "modes", Messages: "texts" });
    this.list = el("ol", { class: "messages" });
    this.quiet = el("p", { class: "quiet" });
    this.element = el(
      "div",
      {},
      el("div", { class: "timeline" }, ...named.flatMap(([title, lane]) => [el("span", {}, title), this.lanes[lane]])),
      this.quiet,
      this.list,
    );
  }

  update(past, [from, to]) {
    const place = (start, end) => {
      const left = Math.max(0, (start - from) / (to - from));
      return [100 * left, 100 * (Math.min(1, (end - from) / (to - from)) - left)];
    };
    this.#bars(this.lanes.alarms, alarmBars(past.spells), from, place);
    const modes = past.modes.map((one, k) => ({
      key: one.time_s,
      start: one.time_s,
      end: past.modes[k + 1]?.time_s ?? to,
      kind: one.mode.includes("disarmed") ? "mode disarmed" : "mode",
      text: one.mode,
      title: `${one.mode} from ${timeOfDay(one.time_s)}`,
    }));
    this.#bars(this.lanes.modes, modes, from, place);
    const texts = past.texts.map((one) => ({
      key: `${one.time_s} ${one.text}`,
      start: one.time_s,
      end: one.time_s,
      kind: one.severity <= LOUD ? "tick loud" : "tick",
      text: "",
      title: `${timeOfDay(one.time_s)} ${one.text}`,
    }));
    this.#bars(this.lanes.texts, texts, from, place);
    say(this.quiet, past.texts.length ? "" : "The autopilot said nothing.");
    sync(this.list, past.texts.slice(-8).reverse(), (one) => `${one.time_s} ${one.text}`, makeText, () => {});
  }

  #bars(lane, bars, from, place) {
    const shown = bars.filter((bar) => bar.end >= from);
    sync(lane, shown, (bar) => String(bar.key), () => el("span", {}), (element, bar) => {
      const [left, width] = place(bar.start, bar.end);
      element.className = bar.kind;
      element.style.left = `${left}%`;
      if (!bar.kind.startsWith("tick")) element.style.width = `${width}%`;
      if (bar.lane !== undefined) element.style.top = `${bar.lane * 1.5}rem`;
      element.title = bar.title;
      say(element, bar.text);
    });
    const lanes = Math.max(1, ...shown.map((bar) => (bar.lane ?? 0) + 1));
    lane.style.height = `${lanes * 1.5}rem`;
  }
}

/** Return a bar for each alarm, those of a channel in a lane. */
function alarmBars(spells) {
  const channels = [...new Set(spells.map((spell) => spell.channel))];
  return spells.map((spell) => ({
    key: spell.id,
    start: spell.start,
    end: spell.end,
    lane: channels.indexOf(spell.channel) % 6,
    kind: `alarm ${spell.severity}`,
    text: spell.channel,
    title: `${spell.message}, from ${timeOfDay(spell.start)}`,
  }));
}

function makeText(one) {
  const kind = one.severity <= LOUD ? "loud" : "";
  return el("li", { class: kind }, el("time", {}, timeOfDay(one.time_s)), one.text);
}
