// Margins, frequency response and step of the identified model, with gains to drag.
import { html, useState, useEffect, useRef } from "/static/vendor/htm-preact.js";
import { axisOf, colours, follow } from "/static/charts.js";
import { Said, focusLost } from "/static/bench.js";
import { Range, useNumber } from "/static/number.js";
import { unsaved } from "/static/requests.js";

const STEPS = 400; // of a slider; 0 is a gain of 0, the rest is logarithmic
const DECADES = 4;
const REST_MS = 400; // after the last change, until the slower numbers are computed
const GAINS = [
  { name: "kp", label: "Proportional gain kp", unit: "" },
  { name: "ki", label: "Integral gain ki", unit: "1/s" },
  { name: "kd", label: "Derivative gain kd", unit: "s" },
  { name: "derivative_filter_s", label: "Time constant of the derivative filter", unit: "s" },
];
const PLOTS = [
  { key: "magnitude", title: "Magnitude", unit: "dB", of: "bode", names: ["open loop", "plant", "0 dB"] },
  { key: "phase", title: "Phase", unit: "°", of: "bode", names: ["open loop", "plant", "−180°"] },
  { key: "step", title: "Output", of: "step", names: ["measured", "reference"] },
  { key: "controller", title: "Controller", of: "step", names: ["controller"] },
];
const LEAST_DEG = -540; // of the phase that is shown; a delay turns it without end
const HEIGHT = 210;

const digits = (value, count = 4) => Number(value.toPrecision(count));
const toGain = (position, highest) => (position <= 0 ? 0 : digits(highest * 10 ** (DECADES * (position / STEPS - 1))));
const toPosition = (gain, highest) => (gain > 0 ? Math.min(Math.max(Math.round(STEPS * (1 + Math.log10(gain / highest) / DECADES)), 1), STEPS) : 0);
const same = (one, other) => one !== null && other !== null && GAINS.every(({ name }) => one[name] === other[name]);

let unwritten = null; // gains that were changed here; they stay while another page is shown

// One request at a time; of the wishes meanwhile, only the last one is sent.
class Latest {
  constructor(send, done) { this.send = send; this.done = done; this.busy = false; this.next = null; }
  async want(values) {
    if (this.busy) { this.next = values; return; }
    this.busy = true;
    const answer = await this.send(values);
    this.busy = false;
    const next = this.next;
    this.next = null;
    this.done(answer);
    if (next !== null) this.want(next);
  }
}

function Plot({ about, x, lines, label, unit }) {
  const place = useRef(null), plot = useRef(null);
  useEffect(() => {
    const axis = axisOf(), isBode = about.of === "bode", of = isBode ? ["first", "second", "soft"] : ["first", "soft"];
    plot.current = new uPlot({
      width: Math.max(place.current.clientWidth, 200), height: HEIGHT, legend: { show: false },
      series: [{}, ...about.names.map((name, k) => ({ label: name, stroke: () => colours[of[k]], width: k < 1 ? 2 : 1, dash: k > 0 && k === about.names.length - 1 ? [6, 4] : undefined, points: { show: false } }))],
      scales: { x: { time: false, distr: isBode ? 3 : 1, range: (u, low, high) => [low, high] }, y: about.key === "phase" ? { range: (u, low, high) => uPlot.rangeNum(Math.max(low, LEAST_DEG), high, 0.1, true) } : {} },
      axes: [{ ...axis, label: isBode ? "Frequency (Hz)" : "Time (s)", labelSize: 20 }, { ...axis, size: 60, label: unit ? `${about.title} (${unit})` : about.title, labelSize: 20 }],
      cursor: { drag: { x: false, y: false }, sync: isBode ? { key: "bode" } : undefined },
    }, [[], ...about.names.map(() => [])], place.current);
    const watcher = new ResizeObserver(() => plot.current.setSize({ width: Math.max(place.current.clientWidth, 200), height: HEIGHT }));
    watcher.observe(place.current);
    const forget = follow(plot.current);
    return () => { forget(); watcher.disconnect(); plot.current.destroy(); };
  }, []);
  useEffect(() => { if (plot.current) plot.current.setData([x, ...lines]); }, [x, lines]);
  return html`<section class="card"><p class="values">${label}</p><div role="img" aria-label=${`${about.title}. ${label}`} ref=${place}></div></section>`;
}

function Plots({ found, output, unit }) {
  const { bode, step, margins } = found, count = bode.frequency_hz.length;
  const level = (value) => Array(count).fill(value);
  const key = (names) => `${names.map((name, k) => `${["blue", "orange"][k]}: ${name}`).join(", ")}`;
  const crossover = margins.crossover_rad_s === null ? "no crossover" : `crossover at ${digits(margins.crossover_rad_s / (2 * Math.PI), 3)} Hz`;
  return html`
    <${Plot} about=${PLOTS[0]} unit="dB" x=${bode.frequency_hz} lines=${[bode.loop.magnitude_db, bode.plant.magnitude_db, level(0)]} label=${`${key(["open loop", "plant"])}; ${crossover}`} />
    <${Plot} about=${PLOTS[1]} unit="°" x=${bode.frequency_hz} lines=${[bode.loop.phase_deg, bode.plant.phase_deg, level(-180)]} label=${`${key(["open loop with its delay", "plant"])}; dashed: −180°`} />
    ${step && html`<${Plot} about=${PLOTS[2]} unit=${unit} x=${step.time_s} lines=${[step.measured, step.reference]}
      label=${`Step of the closed loop${output ? `: ${output}` : ""}, as the loop measures it, saturation included; dashed: reference`} />
    <${Plot} about=${PLOTS[3]} unit="" x=${step.time_s} lines=${[step.controller]} label="Output of the controller in this step" />`}`;
}

// In JSON, an infinite margin is null.
function Margins({ found, caption }) {
  const one = (value, unit, none, scale = 1) => (value === null ? none : `${digits(scale * value)} ${unit}`.trim());
  const without = found.stable ? "infinite" : "none";
  const rows = [
    ["Phase margin", one(found.phase_margin_deg, "°", without)],
    ["Gain margin", one(found.gain_margin_db, "dB", without)],
    ["Delay margin", one(found.delay_margin_s, "ms", without, 1e3)],
    ["Peak sensitivity Ms", one(found.peak_sensitivity, "", "infinite")],
    ["Crossover", one(found.crossover_rad_s, "rad/s", "none")],
  ];
  return html`<table class="margins"><caption>${caption}</caption><tbody>
    <tr><th scope="row">Closed loop</th><td>${found.stable ? "stable" : html`<strong class="error">UNSTABLE</strong>`}</td></tr>
    ${rows.map(([name, value]) => html`<tr><th scope="row">${name}</th><td>${value}</td></tr>`)}</tbody></table>`;
}

const summary = (found) => (found.stable ? `Stable, phase margin ${digits(found.phase_margin_deg ?? Infinity, 3)}°, gain margin ${digits(found.gain_margin_db ?? Infinity, 3)} dB.` : html`<strong class="error">UNSTABLE.</strong>`);

function Budget({ found }) {
  const share = (used, all, unit) => `${used.toLocaleString("en")} of ${all.toLocaleString("en")} ${unit} (${digits(100 * used / all, 3)} %)`;
  return html`<table class="margins"><caption>Measured in co-simulation, with the loop closed on a twin for 1 s</caption><tbody>
    <tr><th scope="row">Longest update</th><td>${share(found.longest_update_cycles, found.cycles_of_an_update, "cycles")}</td></tr>
    <tr><th scope="row">Processor, mean</th><td>${digits(100 * found.load, 3)} %</td></tr>
    <tr><th scope="row">Late updates</th><td>${found.overruns}</td></tr>
    <tr><th scope="row">RAM with stack</th><td>${share(found.ram_bytes, found.ram_bytes_available, "B")}</td></tr>
    <tr><th scope="row">Flash</th><td>${share(found.flash_bytes, found.flash_bytes_available, "B")}</td></tr></tbody></table>`;
}

function Gain({ about, value, highest, put, fields }) {
  const typed = useNumber(String(value), { rule: { low: 0 }, enter: put, leave: "commit" });
  fields[about.name] = typed.read;
  const label = `${about.label}${about.unit ? ` in ${about.unit}` : ""}`;
  return html`<div class="gain">
    <label for=${about.name}>${label}</label>
    <${Range} id=${about.name} min="0" max=${STEPS} step="1" value=${toPosition(value, highest)} aria-valuetext=${`${value} ${about.unit}`}
      put=${(position) => put(toGain(position, highest))} />
    <input aria-label=${`${label}, typed`} ...${typed.field} />${typed.line}</div>`;
}

export default function Design({ link, state }) {
  const [about, see] = useState(null);
  const [gains, setGains] = useState(null);
  const [found, find] = useState(null);
  const [demands, setDemands] = useState(null);
  const [said, say] = useState({ text: "", bad: false });
  const [busy, setBusy] = useState("");
  const [budget, setBudget] = useState(null);
  const fields = useRef({}); // by gain: reads what is typed, null if it is not a number
  const requests = useRef(null);
  if (requests.current === null) {
    requests.current = {
      loop: new Latest((values) => link.request("design-loop", values), find),
      demands: new Latest(async (values) => ({ ...(await link.request("design-demands", values)), gains: values }), setDemands),
    };
  }
  function change(next, file = about) {
    const isChanged = !same(next, file.gains);
    unwritten = isChanged ? next : null;
    if (isChanged) unsaved.add("gains"); else unsaved.delete("gains");
    setGains(next);
  }
  async function open() {
    const answer = await link.request("design");
    see(answer);
    find(answer.found ?? null);
    if (answer.gains) change(unwritten ?? answer.gains, answer);
    else setGains(null);
  }
  const reopen = () => { unwritten = null; say({ text: "", bad: false }); return open(); };
  useEffect(() => { open(); }, []);
  useEffect(() => {
    if (gains === null) return undefined;
    requests.current.loop.want(gains);
    const later = setTimeout(() => requests.current.demands.want(gains), REST_MS);
    return () => clearTimeout(later);
  }, [gains]);

  if (about === null) return html`<p role="status">Reading the actuator file …</p>`;
  if (about.none) return html`<div class="card"><h2>Design</h2><p role="status">${about.none}</p></div>`;
  if (about.error) return html`<div class="card"><h2>Design</h2><p class="error" role="alert">${about.error}</p><button type="button" onClick=${reopen}>Read the file again</button></div>`;
  const put = (name) => (value) => { say({ text: "", bad: false }); change({ ...gains, [name]: value }); };
  const isShown = found !== null && !found.error;
  const isNew = isShown && (!about.is_pid || same(found.gains, gains));
  const during = async (name, request) => {
    const pressed = document.activeElement; // a disabled button loses the focus
    setBusy(name);
    const answer = await request();
    setBusy("");
    setTimeout(() => { if (focusLost()) pressed?.focus({ preventScroll: true }); });
    return answer;
  };

  async function compute() {
    const answer = await during("compute", () => link.request("design-search"));
    if (answer.error) { say({ text: answer.error, bad: true }); return; }
    say({ text: "Gains computed. They are not written to the file yet.", bad: false });
    change(answer.gains);
  }
  async function write() {
    if (GAINS.some(({ name }) => fields.current[name]?.() === null)) { say({ text: "Not written: a field has no valid number.", bad: true }); return; }
    const answer = await during("write", () => link.request("design-write", { ...gains, sha256: about.sha256 }));
    if (answer.error) say({ text: answer.error, bad: true });
    else {
      const file = { ...about, gains: { ...gains }, sha256: answer.sha256 };
      see(file);
      change(gains, file);
      find((last) => ({ ...last, sha256: answer.sha256 })); // or it would look changed until the next answer
      const next = state?.holder ? "The armed bench keeps its present controller. Disarm it and arm it again to use the new one." : "Press Arm the bench on the page Live to use it.";
      say({ text: `Written to ${answer.written}. ${next}`, bad: false });
    }
    requests.current.loop.want(gains); // of the file as it is now
  }
  async function measure() {
    setBudget(null);
    const used = { ...gains };
    const answer = await during("measure", () => link.request("design-budget", used));
    setBudget({ ...answer, gains: used });
  }

  return html`<div class="layout design">
    <section class="plots" aria-label="Responses">
      ${about.warnings.map((text) => html`<p class="error">${text}</p>`)}
      ${found?.error && html`<p class="error" role="alert">${found.error}</p>`}
      ${isShown && html`<div class=${isNew ? "all" : "all old"}><${Plots} found=${found} output=${about.output} unit=${about.unit} /></div>`}
    </section>
    <section class="controls" aria-label="Controller">
      <div class="card"><h2>Gains</h2>
        <p>${about.file}</p>
        ${about.kind === null && html`<p>The file has no controller yet. Compute gains, or move the sliders.</p>`}
        ${gains === null && html`<p>The controller has kind = ${about.kind}, but this page changes only the gains of a PI or PID. Edit its parameters in the file.</p>`}
        ${gains !== null && GAINS.map((one) => html`<${Gain} key=${one.name} about=${one} value=${gains[one.name]} highest=${about.ranges[one.name]} put=${put(one.name)} fields=${fields.current} />`)}
        ${isShown && html`<p class=${isNew ? "" : "old"}>${summary(found.margins)}${same(demands?.gains ?? null, gains) && demands?.shortfalls?.length ? html` <span class="error">Demands not met, see Margins.</span>` : ""}</p>`}
        ${isShown && found.sha256 !== about.sha256 && html`<p class="error" role="alert">The file has changed since this page read it. Read it again; the gains that you changed here are then lost.</p>`}
        ${gains !== null && html`<div class="row">
          <button type="button" disabled=${busy !== ""} onClick=${compute}>${busy === "compute" ? "Computing …" : "Compute gains"}</button>
          <button type="button" disabled=${busy !== ""} onClick=${reopen}>Read the file again</button>
          <button type="button" disabled=${busy !== "" || !isShown} onClick=${write}>${busy === "write" ? "Writing …" : "Write to the actuator file"}</button>
          ${unwritten !== null && html`<strong class="changed" role="status">Changed, not written</strong>`}</div>`}
        <${Said} error=${said.bad ? said.text : ""} done=${said.text} />
      </div>
      ${isShown && html`<div class=${`card ${isNew ? "" : "old"}`}><h2>Margins</h2>
        <${Margins} found=${found.margins} caption=${`At ${digits(found.margins.rate_hz)} Hz with a delay of ${digits(1e3 * found.margins.delay_s)} ms`} />
        ${gains !== null && html`<div>
          ${!same(demands?.gains ?? null, gains) ? html`<p>Checking the demands …</p>` : demands.error ? html`<p class="error">${demands.error}</p>` : html`
            ${demands.shortfalls.length ? html`<p class="error">Demands not met for the worst natural frequency within frequency_spread: ${demands.shortfalls.join("; ")}.</p>` : html`<p>All demands are met. They apply to the identified plant, also with its natural frequency changed by frequency_spread.</p>`}
            <p>${demands.plausible}.</p>`}</div>`}
      </div>`}
      ${isShown && found.chip && html`<div class=${`card ${isNew ? "" : "old"}`}><h2>On the ATmega2560</h2>
        <${Margins} found=${found.chip} caption=${`The same gains at ${digits(found.chip.rate_hz)} Hz with a delay of ${digits(1e3 * found.chip.delay_s)} ms`} />
        <div class="row"><button type="button" disabled=${busy !== ""} onClick=${measure}>${busy === "measure" ? "Measuring, some seconds …" : "Measure cycles and memory"}</button></div>
        ${budget?.error && html`<p class="error" role="alert">${budget.error}</p>`}
        ${budget && !budget.error && html`<div class=${same(budget.gains, gains) ? "" : "old"}><${Budget} found=${budget} /></div>`}
      </div>`}
    </section></div>`;
}
