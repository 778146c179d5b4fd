// Arming, and the progress of a study: for the live page and the page of the studies.
import { html, useState, useEffect, useRef } from "/static/vendor/htm-preact.js";
import { useNumber } from "/static/number.js";

export const fixed = (v, count) => (Number(v.toFixed(count)) + 0).toFixed(count); // never -0.0
export const kilo = (v, gain) => `${fixed(v, 3)} V (${fixed(v * gain / 1000, 2)} kV)`;
// A limit; on a bipolar bench it applies to both signs.
export function limitOf(state, v = state.limit_v) {
  const sign = state.low_v < 0 ? "±" : "";
  return `${sign}${fixed(v, 3)} V (${sign}${fixed(v * state.gain / 1000, 2)} kV)`;
}

// What was refused, or done; it is scrolled into view.
export function Said({ error, done = "" }) {
  const place = useRef(null);
  useEffect(() => { place.current?.scrollIntoView({ block: "nearest" }); }, [error, done]);
  if (error) return html`<p class="error" role="alert" ref=${place}>${error}</p>`;
  return html`<p role="status" ref=${place}>${done}</p>`;
}

// Two steps: read the limits, then type one. With a study, the bench is armed to play it.
export function Arming({ state, link, say, study = null, onArmed = () => {} }) {
  const [request, setRequest] = useState(null);
  const [limit, setLimit] = useState("");
  const typed = useNumber(limit, { rule: { above: 0, high: state.high_v }, least: 0, input: setLimit });
  const [known, setKnown] = useState(false);
  const [sent, setSent] = useState(false);
  const open = useRef(false); // whether a request waits for the second step
  open.current = request !== null && !sent;
  const field = useRef(null);
  useEffect(() => { field.current?.focus(); }, [request]);
  const cancel = () => { setRequest(null); link.ask("cancel"); };
  useEffect(() => () => { if (open.current) link.ask("cancel"); }, []);
  async function ask() {
    const obstacle = await stopObstacle();
    if (obstacle) { say(obstacle); return; }
    const found = await link.ask("request");
    if (found.error) { say(found.error); return; }
    say(""); setKnown(false); setLimit(""); setRequest(found.answer);
  }
  async function arm(event) {
    event.preventDefault();
    const limit_v = typed.read();
    if (limit_v === null) return;
    const values = { number: request.number, limit_v, acknowledged: known ? request.reason : "" };
    if (study !== null) values.study = study;
    setSent(true);
    const obstacle = await stopObstacle();
    const found = obstacle ? { error: obstacle } : await link.ask("arm", values);
    setSent(false);
    setRequest(null);
    say(found.error || "");
    if (found.error) link.ask("cancel");
    else onArmed(found.answer);
  }
  if (request === null) return html`<button type="button" onClick=${ask}>${study === null ? "Arm the bench …" : "Arm the bench and play …"}</button>`;
  return html`<form onSubmit=${arm}>
    <p><strong>${state.simulated ? "SIMULATED bench: no voltage is applied." : "HIGH VOLTAGE WILL BE APPLIED. Keep clear."}</strong></p>
    <p>${request.limits}</p>
    ${request.reason && html`<p class="error">The permission of the bench was revoked. Reason: ${request.reason}</p>
      <label><input type="checkbox" checked=${known} onChange=${(e) => setKnown(e.target.checked)} /> The cause has been removed.</label>
      ${!known && html`<p>Arm is possible once this box is ticked.</p>`}`}
    <label>Highest drive of this run, in V at the amplifier's input, at most ${limitOf(state, state.high_v)}
      <input ...${typed.field} ref=${field} />
    </label>${typed.line}
    <div class="row"><button class="danger" type="submit" disabled=${sent || (request.reason && !known)}>${sent ? "Checking …" : study === null ? "Arm" : "Arm and play"}</button>
    <button type="button" onClick=${cancel}>Cancel</button></div>
  </form>`;
}

// What a study does now, on each page.
export function Progress({ state }) {
  const share = Math.round(100 * state.done);
  return html`
    <p role="status">${state.task || "Starting"}</p>
    <progress max="100" value=${share} aria-label="Progress of the study">${share} %</progress> ${share} %`;
}

// A study that this page has started: what it does, what a person must do, and how to end it.
export function Playing({ state, link, say }) {
  const place = useRef(null);
  useEffect(() => { place.current?.scrollIntoView({ block: "center" }); }, []);
  const ask = (what, values = {}) => link.ask(what, values).then((found) => say(found.error || ""));
  return html`
    <p class="badge live" ref=${place}>Playing a study, up to ${limitOf(state)}</p>
    <${Progress} state=${state} />
    ${state.prompt && html`<div class="card warning" role="alert"><p>${state.prompt}</p>
      <button type="button" onClick=${() => ask("confirm", { step: state.step })}>Done</button></div>`}
    <div class="row"><button type="button" onClick=${() => ask("disarm")}>End the study</button></div>
    <p>Keep this page open. If it is closed, the study ends at 0 V.</p>`;
}
