// Charts of the live signals. Each column shows its smallest and its largest value.
export const resolved = (name) => { // light-dark() is resolved by the browser, not by the canvas
  const probe = document.createElement("span");
  probe.style.color = `var(${name})`;
  document.body.append(probe);
  const found = getComputedStyle(probe).color;
  probe.remove();
  return found;
};

// The colours of all plots, which read them at each draw. A change must not reload the page: that would end a run.
export const colours = {};
const painted = new Set(); // plots that are drawn again when the system becomes light or dark
function paint() {
  for (const name of ["text", "line", "first", "second", "soft"]) colours[name] = resolved(`--${name}`);
  for (const plot of painted) plot.redraw(false);
}
paint();
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", paint);
export function follow(plot) { // until the function that this returns is called
  painted.add(plot);
  return () => painted.delete(plot);
}
export const axisOf = () => ({ stroke: () => colours.text, grid: { stroke: () => colours.line, width: 1 }, ticks: { stroke: () => colours.line } });

const HEIGHT = 130;
// least: lowest height of the axis, in its unit, so that rounding errors do not fill a plot.
const PLOTS = [
  { title: "Voltage", unit: "kV", least: 0.01, of: "monitors", lines: [{ name: "voltage", channel: 0, scale: 1e-3 }] },
  { title: "Strain", unit: "%", least: 0.01, of: "signals", lines: [{ name: "sensed", channel: 3, scale: 100 }, { name: "desired", channel: 1, scale: 100 }] },
  { title: "Capacitance", unit: "pF", least: 0.1, of: "signals", lines: [{ name: "capacitance", channel: 2, scale: 1e12 }] },
  { title: "Current", unit: "mA", least: 0.001, of: "monitors", lines: [{ name: "current", channel: 1, scale: 1e3 }] },
  { title: "Drive", unit: "V", least: 0.001, of: "signals", lines: [{ name: "drive", channel: 0, scale: 1 }, { name: "monitor minus drive", channel: 4, scale: 1 }] },
];

const digits = (v) => Number(v.toPrecision(4));
const range = (low, high, unit) => {
  if (low === null || low === undefined) return "–";
  return digits(low) === digits(high) ? `${digits(high)} ${unit}` : `${digits(low)} to ${digits(high)} ${unit}`;
};

// Ticks of the time axis: as many decimals as their distance needs, such as one for 2.5 s.
const decimals = (step) => [0, 1, 2, 3, 4, 5].find((n) => Math.abs(step * 10 ** n - Math.round(step * 10 ** n)) < 1e-6) ?? 6;
export const numbers = (u, ticks, axis, space, step) => ticks.map((v) => v.toFixed(decimals(step)).replace(/^-(0[.0]*)$/, "$1"));
export const heights = (least) => (u, low, high) => {
  if (low === null || high === null) return [null, null];
  const more = Math.max(least - (high - low), 0) / 2;
  return uPlot.rangeNum(low - more, high + more, 0.1, true);
};
export const seconds = (u, ticks, axis, space, step) => ticks.map((v) => `${v.toFixed(decimals(step))} s`);

export class Charts {
  constructor(root, onZoom, onResize) {
    this.onZoom = onZoom;
    this.onResize = onResize;
    this.dragged = false;
    this.events = []; // time and text of each, marked in all plots
    addEventListener("mouseup", () => { this.dragged = false; });
    this.plots = PLOTS.map((about) => this.make(root, about));
    new ResizeObserver(() => this.resize()).observe(root);
  }

  make(root, about) {
    const card = document.createElement("section");
    card.className = "card";
    card.tabIndex = 0;
    card.setAttribute("aria-label", `${about.title} in ${about.unit}. Arrow keys move the view, plus and minus zoom, End shows the present.`);
    card.addEventListener("keydown", (event) => this.onZoom({ key: event.key, event }));
    const values = document.createElement("p");
    values.className = "values";
    card.append(values);
    root.append(card);
    const series = [{ label: "time" }];
    const bands = [];
    about.lines.forEach((one, k) => {
      const stroke = () => colours[k ? "second" : "first"];
      series.push({ label: `${one.name}, highest`, stroke, width: 1, points: { show: false } });
      series.push({ label: `${one.name}, lowest`, stroke, width: 1, points: { show: false } });
      bands.push({ series: [2 * k + 1, 2 * k + 2], fill: () => stroke().replace("rgb(", "rgba(").replace(")", ", 0.35)") });
    });
    const axis = axisOf();
    const plot = new uPlot({
      width: Math.max(card.clientWidth - 24, 200), height: HEIGHT, series, bands, legend: { show: false },
      padding: [null, null, null, (u, side, sides) => (sides[side] ? 0 : 90)], // without data there is no left axis, but all time axes are aligned
      scales: { x: { time: false }, y: { range: heights(about.least) } },
      axes: [{ ...axis, size: 32, values: seconds }, { ...axis, size: 70, space: 20, label: about.unit, labelSize: 20, values: numbers }],
      cursor: { sync: { key: "haselab" }, drag: { x: true, y: false, setScale: false } },
      hooks: {
        draw: [(u) => this.mark(u, colours.text)],
        setSelect: [(u) => {
          if (u.select.width < 3) return;
          const from = u.posToVal(u.select.left, "x"), to = u.posToVal(u.select.left + u.select.width, "x");
          u.setSelect({ left: 0, width: 0, top: 0, height: 0 }, false);
          this.onZoom({ from, to });
        }],
      },
    }, series.map(() => []), card);
    follow(plot);
    plot.over.addEventListener("mousedown", () => { this.dragged = true; }); // the view stays meanwhile
    plot.over.addEventListener("dblclick", () => this.onZoom({ key: "End" }));
    return { about, plot, card, values };
  }

  mark(u, colour) {
    const { ctx, bbox } = u, ratio = devicePixelRatio;
    ctx.save();
    ctx.strokeStyle = ctx.fillStyle = colour;
    ctx.font = `${11 * ratio}px system-ui, sans-serif`;
    ctx.setLineDash([4 * ratio, 4 * ratio]);
    ctx.textAlign = "left"; // uPlot leaves another
    ctx.textBaseline = "alphabetic";
    let free = -Infinity; // where the last text ends
    for (const [at_s, what] of this.events) {
      if (at_s < u.scales.x.min || at_s > u.scales.x.max) continue;
      const x = Math.round(u.valToPos(at_s, "x", true)), label = what.length > 28 ? `${what.slice(0, 27)}…` : what;
      ctx.beginPath();
      ctx.moveTo(x, bbox.top);
      ctx.lineTo(x, bbox.top + bbox.height);
      ctx.stroke();
      const width = ctx.measureText(label).width + 4 * ratio, fits = x + width < bbox.left + bbox.width;
      const from = fits ? x + 4 * ratio : x - width; // at the right edge, before the line
      if (from < free) continue;
      ctx.fillText(label, from, bbox.top + 12 * ratio);
      free = from + width;
    }
    ctx.restore();
  }

  resize() {
    if (this.plots[0].card.clientWidth === 0) return; // another page is shown
    for (const { plot, card } of this.plots) plot.setSize({ width: Math.max(card.clientWidth - 24, 200), height: HEIGHT });
    this.onResize(this.columns());
  }

  columns() { return Math.round((this.plots[0].plot.bbox.width || 800) / 2) || 400; }

  // One plot after the other: STOP waits for one of them at most.
  async draw(frame, from, to) {
    this.events = frame.state.events ?? [];
    for (const { about, plot, values } of this.plots) {
      await new Promise((resolve) => setTimeout(resolve));
      if (this.dragged) return;
      const { start, step, low, high } = frame[about.of];
      const count = low[0].length, x = new Float64Array(count);
      for (let k = 0; k < count; k++) x[k] = start + (k + 0.5) * step;
      const data = [x];
      for (const { channel, scale } of about.lines) {
        for (const side of [high[channel], low[channel]]) data.push(Array.from(side, (v) => (Number.isNaN(v) ? null : v * scale)));
      }
      plot.setData(data, false);
      plot.setScale("x", { min: from, max: to });
      const at = plot.cursor.idx ?? count - 1;
      const parts = about.lines.map((one, k) => `${one.name} ${range(data[2 * k + 2][at], data[2 * k + 1][at], about.unit)}`);
      const when = plot.cursor.idx === null || plot.cursor.idx === undefined ? "" : ` at ${x[at]?.toFixed(4)} s`;
      values.textContent = `${about.title}: ${parts.join(", ")}${when}`;
    }
  }
}
