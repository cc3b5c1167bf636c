// The track in metres around its middle: where the autopilot believes to be, and where GPS was pulled away from.
import { el, say } from "./dom.js";
import { colour } from "./chart.js";
import { figure } from "./words.js";

const EARTH_M = 6378137;
const EDGE = 28;
const LEAST_M = 20; // shown even where a vehicle does not move

function metres(latitude, longitude, origin) {
  const radians = Math.PI / 180;
  const east = (longitude - origin[1]) * radians * EARTH_M * Math.cos(origin[0] * radians);
  return [east, (latitude - origin[0]) * radians * EARTH_M];
}

export class TrackMap {
  constructor() {
    this.canvas = el("canvas", { role: "img" });
    this.said = el("p", { class: "quiet" });
    const legend = [
      ["estimate", "track"],
      ["critical", "where it is, without what GPS was pulled by"],
    ];
    this.element = el(
      "figure",
      { class: "map" },
      this.canvas,
      el(
        "figcaption",
        { class: "legend" },
        ...legend.map(([kind, text]) => el("span", { class: `line ${kind}` }, text)),
      ),
      this.said,
    );
    this.origin = null;
    this.size = new ResizeObserver(() => this.draw());
    this.size.observe(this.canvas);
  }

  close() {
    this.size.disconnect();
  }

  /** Show the span of times; `spells` are those of alarms of GPS. */
  update(status, span, spells) {
    Object.assign(this, { status, span, spells });
    this.draw();
  }

  draw() {
    if (!this.status) return;
    const { track, real } = this.#lines();
    this.element.hidden = false;
    if (!track.length) {
      say(this.said, "The telemetry has no position.");
      this.canvas.hidden = true;
      return;
    }
    this.canvas.hidden = false;
    const width = this.canvas.clientWidth;
    const height = this.canvas.clientHeight;
    const ratio = devicePixelRatio;
    this.canvas.width = width * ratio;
    this.canvas.height = height * ratio;
    const ctx = this.canvas.getContext("2d");
    ctx.scale(ratio, ratio);
    const all = [...track, ...real];
    const bounds = [0, 1].map((k) => [Math.min(...all.map((at) => at[k])), Math.max(...all.map((at) => at[k]))]);
    const spans = bounds.map(([low, high]) => Math.max(high - low, LEAST_M));
    const scale = Math.min((width - 2 * EDGE) / spans[0], (height - 2 * EDGE) / spans[1]);
    const middle = bounds.map(([low, high]) => (low + high) / 2);
    const place = ([east, north]) => [width / 2 + (east - middle[0]) * scale, height / 2 - (north - middle[1]) * scale];
    this.#grid(ctx, width, height, scale, place);
    this.#line(ctx, real.map(place), colour("critical"), 2.5);
    this.#line(ctx, track.map(place), colour("estimate"), 1.5);
    this.#end(ctx, place(track.at(-1)), colour("estimate"));
    if (real.length) this.#end(ctx, place(real.at(-1)), colour("critical"));
    this.#say(track, real);
  }

  /** The track in metres east and north, and the same less what GPS was pulled by, where it was. */
  #lines() {
    const get = (name) => this.status.get(name);
    const has = get("gps_latitude").some((value) => value !== null) ? "gps_" : "";
    const [latitudes, longitudes] = [get(`${has}latitude`), get(`${has}longitude`)];
    const [norths, easts] = [get("gps_north"), get("gps_east")];
    const track = [];
    const real = [];
    this.status.times.forEach((time, k) => {
      if (latitudes[k] === null || longitudes[k] === null || time < this.span[0]) return;
      this.origin ??= [latitudes[k], longitudes[k]];
      const at = metres(latitudes[k], longitudes[k], this.origin);
      track.push(at);
      if (this.#pulled(time) && (norths[k] || easts[k])) real.push([at[0] - (easts[k] ?? 0), at[1] - (norths[k] ?? 0)]);
    });
    return { track, real };
  }

  #pulled(time) {
    return this.spells.some((spell) => spell.start <= time && time <= spell.end);
  }

  #grid(ctx, width, height, scale, place) {
    const rough = 90 / scale;
    const power = 10 ** Math.floor(Math.log10(rough));
    const step = [1, 2, 5, 10].map((k) => k * power).find((k) => k >= rough);
    const [left, bottom] = place([0, 0]);
    ctx.strokeStyle = colour("grid");
    ctx.lineWidth = 1;
    ctx.beginPath();
    for (let x = left % (step * scale); x < width; x += step * scale) {
      ctx.moveTo(x, 0);
      ctx.lineTo(x, height);
    }
    for (let y = bottom % (step * scale); y < height; y += step * scale) {
      ctx.moveTo(0, y);
      ctx.lineTo(width, y);
    }
    ctx.stroke();
    ctx.fillStyle = ctx.strokeStyle = colour("ink-soft");
    ctx.font = "12px system-ui, sans-serif";
    ctx.lineWidth = 2;
    ctx.beginPath();
    ctx.moveTo(12, height - 12);
    ctx.lineTo(12 + step * scale, height - 12);
    ctx.stroke();
    ctx.fillText(`${figure(step)} m`, 14, height - 18);
    ctx.fillText("N", width - 20, 16);
    ctx.beginPath();
    ctx.moveTo(width - 16, 42);
    ctx.lineTo(width - 16, 22);
    ctx.lineTo(width - 20, 28);
    ctx.moveTo(width - 16, 22);
    ctx.lineTo(width - 12, 28);
    ctx.stroke();
  }

  #line(ctx, points, stroke, width) {
    ctx.strokeStyle = stroke;
    ctx.lineWidth = width;
    ctx.lineJoin = "round";
    ctx.beginPath();
    points.forEach(([x, y], k) => (k ? ctx.lineTo(x, y) : ctx.moveTo(x, y)));
    ctx.stroke();
  }

  #end(ctx, [x, y], fill) {
    ctx.fillStyle = fill;
    ctx.beginPath();
    ctx.arc(x, y, 5, 0, 2 * Math.PI);
    ctx.fill();
  }

  #say(track, real) {
    const [east, north] = track.at(-1);
    const altitude = this.status.last("gps_altitude") ?? this.status.last("altitude");
    const height = altitude === null ? "" : `, ${figure(altitude, 4)} m above the sea`;
    const where = `${figure(Math.hypot(east, north))} m from where it was first seen${height}`;
    const [north_m, east_m] = [this.status.last("gps_north") ?? 0, this.status.last("gps_east") ?? 0];
    const pulled = this.#pulled(this.status.times.at(-1)) && (north_m || east_m) ? `; GPS is pulled by ${figure(Math.hypot(north_m, east_m))} m` : "";
    say(this.said, where + pulled);
    this.canvas.setAttribute("aria-label", `Track: ${where}${pulled}`);
  }
}
