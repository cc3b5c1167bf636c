// Draws the charts of a report with uPlot; they share one axis of time: drag to zoom all, double click to see all again.
"use strict";
(() => {
  const contents = JSON.parse(document.getElementById("charts").textContent);
  const plots = [];
  let following = false;

  const colour = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
  const LINES = ["--series0", "--series1", "--series2", "--series3", "--series4", "--series5", "--muted"];
  const SEVERITY = { warning: "--series1", critical: "--series5" };
  const UNCERTAIN = "40", ALARM = "38", UNWATCHED = "24"; // opacity of areas, hexadecimal

  const stroke = (kind, index) =>
    ({ estimate: "--series0", truth: "--ink" })[kind] ?? LINES[index % LINES.length];

  function area(plot, from, to, fill) {
    const { ctx, bbox } = plot;
    const left = Math.max(bbox.left, plot.valToPos(from, "x", true));
    const right = Math.min(bbox.left + bbox.width, plot.valToPos(to, "x", true));
    if (right <= left) return;
    ctx.fillStyle = fill;
    ctx.fillRect(left, bbox.top, Math.max(right - left, 2), bbox.height);
  }

  // Behind the lines: where nothing was watched, and where alarms were active.
  function background(plot, content) {
    const end = content.x[content.x.length - 1];
    for (const [from, to] of content.unwatched) area(plot, from, to, colour("--muted") + UNWATCHED);
    for (const span of content.spans) area(plot, span.from, span.to ?? end, colour(SEVERITY[span.severity]) + ALARM);
  }

  // Over the lines: the threshold on both sides, and moments with a name.
  function foreground(plot, content) {
    const { ctx, bbox } = plot;
    const line = (x0, y0, x1, y1) => { ctx.beginPath(); ctx.moveTo(x0, y0); ctx.lineTo(x1, y1); ctx.stroke(); };
    ctx.save();
    ctx.beginPath(); ctx.rect(bbox.left, bbox.top, bbox.width, bbox.height); ctx.clip();
    ctx.strokeStyle = ctx.fillStyle = colour("--ink");
    ctx.lineWidth = devicePixelRatio;
    ctx.setLineDash([2 * devicePixelRatio, 4 * devicePixelRatio]);
    for (const level of content.threshold ? [-content.threshold, content.threshold] : []) {
      const y = plot.valToPos(level, "y", true);
      line(bbox.left, y, bbox.left + bbox.width, y);
    }
    ctx.textAlign = "left";
    ctx.font = `${11 * devicePixelRatio}px system-ui, sans-serif`;
    // What began before the left edge is named there, the last of it alone; names that would overlap stand lower.
    const marks = (content.marks ?? []).map(([at, words]) => [plot.valToPos(at, "x", true), words]);
    const ends = [];
    for (const [x, words] of marks.slice(Math.max(0, marks.findLastIndex(([x]) => x <= bbox.left)))) {
      const left = Math.max(x, bbox.left) + 4 * devicePixelRatio;
      const free = ends.findIndex((end) => end < left);
      const lane = free < 0 ? ends.length : free;
      ends[lane] = left + ctx.measureText(words).width;
      line(x, bbox.top, x, bbox.top + bbox.height);
      ctx.fillText(words, left, bbox.top + 12 * (lane + 1) * devicePixelRatio);
    }
    ctx.restore();
  }

  // The same stretch of time in all charts of one window; a page without windows has one.
  function follow(plot, key) {
    if (key !== "x" || following) return;
    following = true;
    for (const other of plots) {
      if (other === plot || other.cursor.sync.key !== plot.cursor.sync.key) continue;
      other.setScale("x", { min: plot.scales.x.min, max: plot.scales.x.max });
    }
    following = false;
  }

  function options(content, width) {
    const names = content.series.map((one) => one.name);
    const low = names.indexOf("low"), high = names.indexOf("high");
    const axis = { stroke: () => colour("--ink"), grid: { stroke: () => colour("--line"), width: 1 }, ticks: { show: false } };
    const series = content.series.map((one, index) => ({
      label: one.of ? `${one.name} (${one.of})` : one.name,
      stroke: () => (one.kind ? colour(stroke(one.kind, index)) : "transparent"),
      dash: one.kind === "truth" ? [6, 4] : undefined,
      width: one.kind === "truth" ? 2 : 1.3,
      points: { show: false },
      class: one.kind ? undefined : "hidden",
      value: (_, value) => (value == null ? "–" : value.toPrecision(3)),
    }));
    return {
      width, height: 240,
      series: [{ label: "s", value: (_, value) => (value == null ? "–" : value.toFixed(2)) }, ...series],
      bands: low < 0 ? [] : [{ series: [high + 1, low + 1], fill: () => colour("--series0") + UNCERTAIN }],
      scales: { x: { time: false }, y: { range: content.limits ?? undefined } },
      axes: [{ ...axis, label: content.since, size: 34, labelSize: 18 }, { ...axis, size: 62, label: content.unit, labelSize: 18 }],
      cursor: { sync: { key: `run ${content.window ?? ""}` }, drag: { x: true, y: false } },
      hooks: {
        drawClear: [(plot) => background(plot, content)],
        draw: [(plot) => foreground(plot, content)],
        setScale: [follow],
      },
    };
  }

  for (const place of document.querySelectorAll("[data-chart]")) {
    const content = contents[Number(place.dataset.chart)];
    const data = [content.x, ...content.series.map((one) => one.y)];
    const plot = new uPlot(options(content, place.clientWidth || 640), data, place);
    plots.push(plot);
    if (content.window) plot.setScale("x", { min: content.window[0], max: content.window[1] });
    new ResizeObserver(() => {
      if (place.clientWidth && place.clientWidth !== plot.width) plot.setSize({ width: place.clientWidth, height: 240 });
    }).observe(place);
  }
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => plots.forEach((plot) => plot.redraw()));
})();
