import { html, render, useState, useEffect, useReducer, useRef } from "/static/vendor/htm-preact.js";
import { Charts } from "/static/charts.js";
import { Link } from "/static/link.js";
import { Arming, Playing, Progress, Said, focusLost, kilo, limitOf, othersDo } from "/static/bench.js";
import { Range, stepsOf, useNumber } from "/static/number.js";
import { unsaved } from "/static/requests.js";

const STALE_MS = 450;
const ANSWERED_MS = 350; // since the last state of a twin that computes; looked at every 100 ms
const LOST_MS = 1500; // without data: what is shown of the bench is old, and commands are useless
const MOST_PAUSE_MS = 1000; // between two draws
let frame = null;
let charts = null;
let redraw = () => {};
let drawing = false;

const link = new Link((found) => {
  frame = found;
  if (!drawing) drawNewest();
}, () => redraw());

window.stopBesides = () => link.ask("stop");

// Pauses three times as long as a draw took, but for 1 s at most, so that a slow computer is free for STOP.
async function drawNewest() {
  drawing = true;
  try {
    for (let drawn = null; drawn !== frame;) {
      await new Promise((resolve) => requestAnimationFrame(resolve));
      drawn = frame;
      const begun_ms = performance.now();
      await draw();
      const took_ms = performance.now() - begun_ms;
      // The computer may have slept during the draw: the pause has a limit.
      await new Promise((resolve) => setTimeout(resolve, Math.min(3 * took_ms, MOST_PAUSE_MS)));
    }
  } finally {
    drawing = false;
  }
}

async function draw() {
  redraw();
  if (frame === null || charts === null || frame.end_s === null || charts.dragged) return;
  const end = link.view.end_s ?? frame.end_s;
  await charts.draw(frame, end - link.view.span_s, end);
}

function zoom({ from, to, key, event }) {
  if (frame === null || frame.end_s === null) return;
  const { span_s } = link.view, end = link.view.end_s ?? frame.end_s;
  const moves = { ArrowLeft: -0.25, ArrowRight: 0.25 }, factors = { "+": 0.5, "=": 0.5, "-": 2 };
  if (from !== undefined) link.setView({ span_s: Math.max(to - from, 1e-4), end_s: to });
  else if (key in moves) link.setView({ end_s: end + moves[key] * span_s });
  else if (key in factors) link.setView({ span_s: Math.min(Math.max(span_s * factors[key], 1e-4), 1200), end_s: link.view.end_s });
  else if (key === "End") link.setView({ span_s: 10, end_s: null });
  else return;
  if (event) event.preventDefault();
}

// A value that the bench refused is named at its field, until another command or the next key.
function Slider({ name, unit, low, high, value, send, about, refused, begun }) {
  const [sent, setSent] = useState(null); // until the bench has it
  useEffect(() => setSent(null), [value]);
  const put = (number) => { setSent(String(number)); send(number).then((found) => { if (found.error || found.answer?.note) setSent(null); }); };
  const now = sent ?? String(Number(value.toPrecision(6)));
  const typed = useNumber(now, { least: low, most: high, enter: put, leave: "reset", refused, begun });
  const ends = [low, high].map((v) => Number(v.toPrecision(6)));
  return html`<label>${name}, in ${unit}, ${ends[0]} to ${ends[1]}${about ? `: ${about}` : ""}
    <${Range} ...${stepsOf(low, high)} value=${now} put=${put} /></label>
    <label>${name}, typed, in ${unit}, ${ends[0]} to ${ends[1]} (press Enter)
    <input ...${typed.field} /></label>${typed.line}`;
}

function Live({ state, say }) {
  const [note, setNote] = useState(""); // about the last command
  const [refused, refuse] = useState({}); // by the command: why the bench refused its last value
  const ask = (what, values) => link.ask(what, values).then((found) => {
    say(found.limit ? "" : found.error || "");
    refuse(found.limit ? { [what]: found.error } : {});
    setNote(found.answer?.note ?? "");
    return found;
  });
  const at = (what) => ({ refused: refused[what] ?? "", begun: () => { refuse({}); say(""); } });
  const place = useRef(null);
  const isLooped = state.mode === "loop";
  useEffect(() => { // after Arm, and after Open the loop; in the field, a key that is still down does nothing
    if (state.mode !== "study" && focusLost()) place.current?.querySelector("input[inputmode]").focus();
  }, [isLooped]);
  const low = Math.max(state.low_v, -state.limit_v);
  if (state.mode === "study") return html`<${Playing} state=${state} link=${link} say=${say} />`;
  return html`<div ref=${place}>
    ${note && html`<p role="status">${note}</p>`}
    <p class="badge live">Armed by this page up to ${limitOf(state)}</p>
    <p>The sensing signal is on, also while the drive is 0 V. Driving by hand is not recorded.</p>
    <${Slider} name="Drive" unit="V" low=${low} high=${state.limit_v} value=${state.target_v} ...${at("drive")}
      about=${`now ${kilo(state.drive_v, state.gain)}, ${state.mode === "loop" ? "set by the controller" : `changes by 1 V/s (${Number((state.gain / 1000).toPrecision(3))} kV/s at the output)`}`} send=${(v) => ask("drive", { value_v: v })} />
    ${state.loop === null
      ? html`<p>The loop cannot be closed: there is no actuator file with both maps and a controller. Start the panel with <code>--actuator FILE</code>. A study with <code>[triangle]</code>, <code>[chirp]</code> and <code>[steps]</code> writes one, actuator.toml, into the folder of its recording. For one from example records, run <code>haselab example actuator --out example</code> and follow its README.md.</p>`
      : html`<${Slider} name="Desired strain" unit="%" low=${100 * state.loop[0]} high=${100 * state.loop[1]} ...${at("loop")}
          value=${100 * (state.reference ?? 0)} about=${state.mode === "loop" ? "closed loop" : "the loop is open; moving this slider closes it, and the drive jumps to what the controller puts out"}
          send=${(v) => ask("loop", { strain: v / 100 })} />`}
    <div class="row">
      <button type="button" onClick=${() => ask("drive", { value_v: 0 })}>Ramp to 0 V</button>
      ${state.mode === "loop" && html`<button type="button" onClick=${() => ask("open")}>Open the loop</button>`}
      <button type="button" onClick=${() => ask("disarm").then(() => scrollTo(0, 0))}>Disarm</button>
    </div></div>`;
}

function Camera({ filming }) {
  const [seen, see] = useState({ url: "", age_s: null, size: [1, 1], points: [] });
  useEffect(() => {
    let url = "", timer = 0, closed = false;
    async function look() {
      try {
        const answer = await fetch("/camera", { headers: { "X-Panel-Token": link.token }, signal: AbortSignal.timeout(2000) });
        if (answer.status === 200) {
          const old = url;
          url = URL.createObjectURL(await answer.blob());
          see({ url, age_s: Number(answer.headers.get("x-age-s")), ...JSON.parse(answer.headers.get("x-fiducials")) });
          if (old) setTimeout(() => URL.revokeObjectURL(old), 1000);
        } else see({ url: "", age_s: null, size: [1, 1], points: [] });
      } catch { see((last) => ({ ...last, age_s: Infinity })); }
      if (!closed) timer = setTimeout(look, filming ? 200 : 2000); // one request at a time
    }
    look();
    return () => { closed = true; clearTimeout(timer); };
  }, [filming]);
  const old = !filming || !(seen.age_s < 1), { points, size } = seen;
  const moved = Math.max(...points.map(([x, y, x0, y0]) => Math.hypot(x - x0, y - y0)));
  return html`<div class="card"><h2>Camera</h2>
    ${seen.url ? html`<div class=${`frame seen ${old ? "old" : ""}`}><img src=${seen.url} alt="Actuator in the last frame of the camera" />
        <svg viewBox=${`-0.5 -0.5 ${size[0]} ${size[1]}`} aria-hidden="true">${points.map(([x, y, x0, y0]) => ["halo", "mark"].map((layer) => html`<g class=${layer}>
          <circle cx=${x} cy=${y} r=${size[1] / 50} /><line x1=${x0} y1=${y0} x2=${x} y2=${y} /></g>`))}</svg></div>
      <p class=${old ? "error" : ""}>${old ? `OLD PICTURE. ${filming ? "No new picture has arrived." : "The camera only films while the bench is armed."}` : "5 frames/s"}</p>
      <p>${points.length ? `${points.length} fiducials found. The largest motion since the first picture is ${moved.toFixed(1)} px.` : "The fiducials are not found in this picture."}</p>`
      : html`<p>No picture. The camera starts when the bench is armed.</p>`}</div>`;
}

const STAGES = { requested: "arming, waiting for the typed limit" }; // in other words than those of the program

// Each is a module with a default component, imported when it is first opened.
const TABS = {
  Live: "", Studies: "/static/studies.js", Pick: "/static/pick.js", Design: "/static/design.js", Doctor: "/static/doctor.js",
};

// The page is named in the address, so that Back, Forward and Reload show the right one.
const named = () => { const name = location.hash.slice(1); return Object.hasOwn(TABS, name) ? name : "Live"; };

function Lazy({ from, ...rest }) {
  const [found, find] = useState({ part: null, error: "" });
  useEffect(() => {
    import(from).then((module) => find({ part: module.default, error: "" }), () => find({ part: null, error: "there is no connection to the panel. Check that it runs, then open this page again" }));
  }, [from]);
  if (found.error) return html`<p class="error">This page cannot be loaded: ${found.error}.</p>`;
  return found.part ? html`<${found.part} ...${rest} />` : html`<p>Loading …</p>`;
}

function Panel() {
  const [tab, show] = useState(named());
  const open = (name) => { location.hash = name; };
  const [, force] = useReducer((n) => n + 1, 0);
  const [error, say] = useState("");
  useEffect(() => {
    redraw = force;
    addEventListener("hashchange", () => show(named()));
    charts = new Charts(document.getElementById("charts"), zoom, (columns) => {
      if (columns !== link.view.columns) link.setView({ columns });
    });
  }, []);
  const state = frame?.state?.stage ? frame.state : null;
  // A twin that computes still sends its state, and says so; the bench is silent if this state is old, too.
  const computing = link.age_ms > STALE_MS && Boolean(state?.computing) && link.stateAge_ms < ANSWERED_MS;
  const stale = link.age_ms > STALE_MS && !computing, lost = link.age_ms > LOST_MS && !computing;
  const seconds = link.age_ms / 1000;
  const age = !Number.isFinite(seconds) ? "NO DATA YET" : computing ? `The simulated bench is computing: no new data for ${seconds.toFixed(1)} s` : `NO NEW DATA for ${seconds.toFixed(1)} s`;
  const live = state !== null && state.holder !== "";
  const mine = live && state.holder === link.holder;
  const tripped = state?.stage === "tripped";
  useEffect(() => { if (tripped) say(""); }, [tripped]); // the reason of the trip is shown instead
  const others = othersDo(state, link);
  useEffect(() => { if (others) say(""); }, [others]);
  useEffect(() => { if (!mine && focusLost()) document.querySelector(".layout .arm")?.focus({ preventScroll: true }); }, [mine]); // after Disarm
  const paused = link.view.end_s !== null;
  document.body.classList.toggle("stale", stale);
  document.body.classList.toggle("paused", paused || computing);
  document.body.classList.toggle("lost", lost);
  if (mine && !lost) unsaved.add("armed"); else unsaved.delete("armed");
  const stage = state ? `${STAGES[state.stage] ?? state.stage}${live ? `, ${kilo(state.drive_v, state.gain)}` : ""}` : "";
  const bench = state === null ? "Bench: unknown" : stale ? `Bench: unknown (last: ${stage})` : `Bench: ${stage}`;
  const corner = document.getElementById("corner-state"), said = stale ? `${age}. ${bench}` : bench;
  if (corner.textContent !== said) corner.textContent = said;
  corner.className = stale || tripped ? "bad" : live ? "live" : "";
  const old = "What is shown of the bench is old, and commands are not carried out.";
  const jumped = typeof frame?.gap_s === "number" && frame.gap_s > (link.view.end_s ?? frame.end_s) - link.view.span_s;
  return html`
    <header>
      <h1>${state ? state.name : "haselab panel"}</h1>
      ${state?.simulated && html`<span class="badge">SIMULATED</span>`}
      <span class=${`badge ${live ? "live" : ""} ${stale || tripped ? "bad" : ""}`} role="status">${bench}</span>
      <span id="age" class=${`badge ${stale ? "bad" : paused || computing ? "live" : ""}`} role="status">${stale || computing ? age : paused ? `VIEW PAUSED at ${link.view.end_s.toFixed(1)} s` : "data live"}</span>
    </header>
    <nav class="row" aria-label="Pages">
      ${Object.keys(TABS).map((name) => html`<button type="button" aria-current=${name === tab ? "page" : "false"} onClick=${() => open(name)}>${name}</button>`)}
    </nav>
    ${TABS[tab] && html`<main class="tab"><${Lazy} from=${TABS[tab]} key=${tab} link=${link} state=${state} mine=${mine} show=${open} /></main>`}
    <div class="layout" role=${tab === "Live" ? "main" : null} hidden=${tab !== "Live"}>
      <section class="charts" aria-label="Signals">
        <div class="row" role="group" aria-label="View">
          <button type="button" aria-pressed=${paused} onClick=${() => link.setView(paused ? { end_s: null } : { end_s: frame?.end_s ?? null })}>${paused ? "Resume" : "Pause"}</button>
          ${[1, 10, 60, 600].map((s) => html`<button type="button" aria-pressed=${link.view.span_s === s} onClick=${() => link.setView({ span_s: s })}>${s} s</button>`)}
          ${jumped && html`<span class="error" role="status">The time of the bench jumped at ${frame.gap_s.toFixed(2)} s. Earlier data are not shown.</span>`}
          <span>${Number(link.view.span_s.toPrecision(3))} s shown. Drag over a plot to zoom. Double-click a plot to return to live data.</span>
        </div>
        <div id="charts"></div>
      </section>
      <section class="controls" aria-label="Bench">
        <div class=${`card ${live ? "warning" : ""}`}>
          <h2>Bench</h2>
          ${lost && state !== null && html`<p class="error" role="status">${old}</p>`}
          <fieldset class="plain" disabled=${lost}>
          ${link.problem && html`<p class="error" role="alert">${link.problem}</p>`}
          <${Said} error=${error} />
          ${state?.reason && html`<p class=${state.stage === "tripped" ? "error" : ""}>Last message of the bench: ${/[.!]$/.test(state.reason) ? state.reason : `${state.reason}.`}${!live && state.drive_v === 0 ? " The drive is 0 V." : ""}</p>`}
          ${state === null ? html`<p>No data from the bench process. If this does not change, read the messages in the terminal of haselab panel.</p>`
            : mine ? html`<${Live} state=${state} say=${say} />`
            : live ? html`<p class="badge live">Armed by another page up to ${limitOf(state)}</p>
              ${state.mode === "study" && html`<p>It plays a study.</p><${Progress} state=${state} />`}`
            : html`<${Arming} state=${state} link=${link} say=${say} />`}
          ${state?.extrapolated && html`<p class=${state.mode === "loop" ? "error" : ""} role="status">The sensed strain is extrapolated: the capacitance is outside the range of the strain map${state.mode === "loop" ? "" : ", as it may be near 0 V"}.</p>`}
          </fieldset>
        </div>
        <${Camera} filming=${live} />
      </section>
    </div>`;
}

render(html`<${Panel} />`, document.getElementById("panel"));
