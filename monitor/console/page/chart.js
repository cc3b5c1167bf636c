// Time series with uPlot: a value with its uncertainty against a threshold, or some lines.
import { el, say } from "./dom.js";
import { figure, signed } from "./words.js";

const HEIGHT = 130;
const SYNC = uPlot.sync("time");

export function colour(name) {
  return getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim();
}

function axes(format) {
  const axis = { stroke: colour("ink-soft"), grid: { stroke: colour("grid"), width: 1 }, ticks: { stroke: colour("grid"), size: 4 } };
  const font = "11px system-ui, sans-serif";
  const clock = (time) => new Date(time * 1000).toISOString().slice(11, 19);
  return [
    { ...axis, font, size: 22, space: 90, values: (_, times) => times.map(clock) },
    { ...axis, font, size: 52, space: 26, values: (_, values) => values.map(format) },
  ];
}

class Chart {
  constructor(title, unit) {
    this.now = el("span", { class: "now" });
    this.box = el("div", { class: "plot" });
    const caption = el("figcaption", {}, el("b", {}, title), el("span", { class: "unit" }, unit), this.now);
    this.element = el("figure", { class: "chart" }, caption, this.box);
    this.plot = null;
    this.span = [0, 1];
    this.seen = false;
    // what nobody sees is not drawn
    this.eye = new IntersectionObserver(([entry]) => {
      this.seen = entry.isIntersecting;
      if (this.seen) this.draw();
    }, { rootMargin: "200px" });
    this.eye.observe(this.element);
    this.size = new ResizeObserver(() => this.plot?.setSize({ width: this.box.clientWidth, height: HEIGHT }));
    this.size.observe(this.box);
  }

  close() {
    this.eye.disconnect();
    this.size.disconnect();
    this.plot?.destroy();
  }

  redraw() {
    this.plot?.destroy();
    this.plot = null;
    this.draw();
  }

  /** Show the span of times, seconds. */
  update(span) {
    this.span = span;
    say(this.now, this.value());
    if (this.seen) this.draw();
  }

  draw() {
    if (!this.box.clientWidth) return;
    const data = this.data();
    if (this.plot === null) this.plot = new uPlot(this.#options(), data, this.box);
    else this.plot.setData(data);
  }

  #options() {
    return {
      width: this.box.clientWidth,
      height: HEIGHT,
      legend: { show: false },
      padding: [6, 6, 0, 0],
      cursor: { sync: { key: SYNC.key }, points: { size: 5 }, drag: { x: false, y: false } },
      axes: axes((value) => figure(value)),
      scales: { x: { time: true, range: () => this.span }, y: { range: (_, low, high) => this.range(low, high) } },
      hooks: { drawClear: [(plot) => this.ground(plot)], setCursor: [(plot) => this.#point(plot)] },
      ...this.series(),
    };
  }

  #point(plot) {
    const at = plot.cursor.idx;
    say(this.now, at === null || at === undefined || plot.cursor.left < 0 ? this.value() : this.value(at));
  }

  ground() {}
}

/** What a fault channel is held responsible for: line, two standard deviations, threshold; red while it is an alarm. */
export class EstimateChart extends Chart {
  constructor(rows, fault, { threshold, unit, factor }) {
    super(fault, unit);
    Object.assign(this, { rows, fault, factor });
    this.threshold = threshold === null ? null : threshold * factor;
    this.spells = [];
  }

  /** Show the span of times with its alarms. */
  update(span, spells) {
    this.spells = spells;
    this.element.dataset.alarm = spells.some((spell) => spell.end >= span[1]);
    super.update(span);
  }

  #scaled(kind) {
    return this.rows.get(`${kind} ${this.fault}`).map((value) => (value === null ? null : value * this.factor));
  }

  data() {
    const { times } = this.rows;
    const size = this.#scaled("isolated");
    const sd = this.#scaled("sd");
    const side = (sign) => size.map((value, k) => (value === null || sd[k] === null ? null : value + sign * 2 * sd[k]));
    const active = (time) => this.spells.some((spell) => spell.start <= time && time <= spell.end);
    const alarm = size.map((value, k) => (this.spells.length && active(times[k]) ? value : null));
    return [times, side(1), side(-1), size, alarm];
  }

  value(at = this.rows.times.length - 1) {
    const size = this.rows.get(`isolated ${this.fault}`)[at];
    const sd = this.rows.get(`sd ${this.fault}`)[at];
    if (size === null || size === undefined) return "–";
    const spread = sd === null ? "" : ` ± ${figure(2 * sd * this.factor, 2)}`;
    const threshold = this.threshold === null ? "" : `, threshold ${figure(this.threshold)}`;
    return `${signed(size * this.factor)}${spread}${threshold}`;
  }

  /** The sizes where there is evidence, not what they are uncertain by: that may be anything at the begin. */
  range() {
    const { times } = this.rows;
    const armed = this.rows.get("armed");
    const sizes = this.rows.get(`isolated ${this.fault}`);
    const least = 1.25 * (this.threshold ?? 1e-9);
    let [low, high] = [-least, least];
    for (let k = times.length - 1; k >= 0 && times[k] >= this.span[0]; k--) {
      if (!armed[k] || sizes[k] === null) continue;
      low = Math.min(low, 1.1 * sizes[k] * this.factor);
      high = Math.max(high, 1.1 * sizes[k] * this.factor);
    }
    return [low, high];
  }

  series() {
    const hidden = { stroke: "transparent", width: 0, points: { show: false } };
    const line = (name, width) => ({ stroke: colour(name), width, points: { show: false } });
    return {
      series: [{}, hidden, hidden, line("estimate", 1.5), line("critical", 2.5)],
      bands: [{ series: [1, 2], fill: colour("band") }],
    };
  }

  /** Behind the lines: times without evidence, the threshold. */
  ground(plot) {
    const { ctx, bbox } = plot;
    const [from, to] = this.span;
    const armed = this.rows.get("armed");
    const { times } = this.rows;
    ctx.save();
    ctx.beginPath();
    ctx.rect(bbox.left, bbox.top, bbox.width, bbox.height);
    ctx.clip();
    ctx.fillStyle = colour("unwatched");
    for (let k = 0; k < times.length; k++) {
      if (armed[k] !== 0 || times[k] > to || (times[k + 1] ?? to) < from) continue;
      const left = plot.valToPos(times[k], "x", true);
      const right = plot.valToPos(Math.min(times[k + 1] ?? to, times[k] + 1), "x", true);
      ctx.fillRect(left, bbox.top, right - left + 1, bbox.height);
    }
    if (this.threshold !== null) {
      ctx.strokeStyle = colour("warning-line");
      ctx.lineWidth = devicePixelRatio;
      ctx.setLineDash([6 * devicePixelRatio, 4 * devicePixelRatio]);
      for (const value of [this.threshold, -this.threshold]) {
        const y = plot.valToPos(value, "y", true);
        ctx.beginPath();
        ctx.moveTo(bbox.left, y);
        ctx.lineTo(bbox.left + bbox.width, y);
        ctx.stroke();
      }
    }
    ctx.restore();
  }
}

/** One line. */
export class LineChart extends Chart {
  constructor(rows, name, title, unit, factor = 1) {
    super(title, unit);
    Object.assign(this, { rows, name, factor });
  }

  data() {
    return [this.rows.times, this.rows.get(this.name).map((value) => (value === null ? null : value * this.factor))];
  }

  value(at = this.rows.times.length - 1) {
    const value = this.rows.get(this.name)[at];
    return value === null || value === undefined ? "–" : figure(value * this.factor);
  }

  range(low, high) {
    const room = 0.05 * ((high ?? 1) - (low ?? 0)) || 1;
    const floor = (low ?? 0) >= 0 ? Math.max(0, (low ?? 0) - room) : low - room;
    return [floor, (high ?? 1) + room];
  }

  series() {
    return { series: [{}, { stroke: colour("estimate"), width: 1.5, points: { show: false } }] };
  }
}
