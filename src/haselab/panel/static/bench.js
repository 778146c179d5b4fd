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

const LEAST_V = 0.001; // that can be typed as a limit
// Whether the control that had the focus is gone.
export const focusLost = () => document.activeElement === null || document.activeElement === document.body;
// What another page has done, armed the bench or asked to: messages about commands of this page are then old.
export function othersDo(state, link) {
  const of = (page, what) => (page && page !== link.holder ? `${what} by ${page}` : "");
  return of(state?.holder, "armed") || of(state?.requester, "requested");
}
// In V, not less than it.
const millivolts = (v) => Number((Math.ceil(1000 * v - 1e-6) / 1000).toFixed(3));

// Two steps: read the limits, then type one. With a study, the bench is armed to play it.
export function Arming({ state, link, say, study = null, needs = 0, onArmed = () => {} }) {
  const [request, setRequest] = useState(null);
  const [limit, setLimit] = useState("");
  const [refused, refuse] = useState("");
  const typed = useNumber(limit, { rule: { low: LEAST_V, high: state.high_v }, least: 0, input: setLimit, refused, begun: () => refuse("") });
  const [known, setKnown] = useState(false);
  const [sent, setSent] = useState(false);
  const open = useRef(false); // whether a request waits for the second step
  open.current = request !== null && !sent;
  const field = useRef(null);
  const first = useRef(null), was = useRef(false);
  useEffect(() => {
    if (request !== null) field.current?.focus();
    else if (was.current && focusLost()) first.current?.focus();
    was.current = request !== null;
  }, [request]);
  const cancel = () => { setRequest(null); link.ask("cancel"); };
  // STOP, or a request of another page, has ended the request of this page.
  const isOpen = state.stage === "requested" && state.requester === link.holder, wasOpen = useRef(false);
  useEffect(() => {
    if (request === null || sent) wasOpen.current = false;
    else if (isOpen) wasOpen.current = true;
    else if (wasOpen.current) setRequest(null);
  }, [request, sent, isOpen]);
  useEffect(() => () => { if (open.current) link.ask("cancel"); }, []);
  async function ask() {
    const obstacle = await stopObstacle();
    if (obstacle) { say(obstacle); return; }
    const found = await link.ask("request");
    if (found.error) { say(found.error); return; }
    say(""); refuse(""); setKnown(false); setLimit(""); setRequest(found.answer);
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
    if (!found.error) { // the next data show it; until then no button of this form acts again
      setTimeout(() => { setSent(false); setRequest(null); }, 2000);
      say("");
      onArmed(found.answer);
      return;
    }
    setSent(false);
    if (found.limit) { refuse(found.error); field.current?.focus(); return; } // the request is still valid
    setRequest(null);
    say(found.error);
    link.ask("cancel");
  }
  if (request === null) return html`${othersDo(state, link) && html`<p role="status">Another page has requested to arm the bench. If you arm the bench here, that request is cancelled.</p>`}
    <button type="button" class="arm" ref=${first} onClick=${ask}>${study === null ? "Arm the bench …" : "Arm the bench and play …"}</button>`;
  const most = limitOf(state, state.high_v), least = millivolts(needs);
  return html`<form onSubmit=${arm}>
    <p><strong>${state.simulated ? "SIMULATED bench: no voltage is applied." : "HIGH VOLTAGE WILL BE APPLIED. Keep clear."}</strong></p>
    ${request.reason && html`<p class="error">The permission of the bench was revoked. Reason: ${request.reason}</p>
      <label><input type="checkbox" checked=${known} onChange=${(e) => setKnown(e.target.checked)} /> The cause has been removed.</label>
      ${!known && html`<p>Arm is possible once this box is ticked.</p>`}`}
    <label>Highest drive of this run, in V at the amplifier's input
      <input ...${typed.field} ref=${field} />
    </label>${typed.line}
    <p>${needs > 0 ? html`This study needs at least <strong>${kilo(least, state.gain)}</strong>. At most: ${most}.` : `Type the smallest limit that you need, at most ${most}.`}</p>
    <div class="row"><button class="danger" type="submit" disabled=${sent || (request.reason && !known)}>${sent ? "Checking …" : study === null ? "Arm" : "Arm and play"}</button>
    <button type="button" onClick=${cancel}>Cancel</button></div>
    <details><summary>All limits of this run</summary><p>${request.limits}</p></details>
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
  // After arming, and after Done. Not on a button: Enter may still be down.
  useEffect(() => { if (focusLost()) place.current?.focus({ preventScroll: true }); }, [state.prompt]);
  const ask = (what, values = {}) => link.ask(what, values).then((found) => say(found.error || ""));
  return html`
    <p class="badge live" tabindex="-1" ref=${place}>Playing a study, up to ${limitOf(state)}</p>
    <${Progress} state=${state} />
    ${state.prompt && html`<div class="card warning" role="alert"><p>${state.prompt}</p>
      <button type="button" onClick=${() => ask("confirm", { step: state.step })}>Done</button></div>`}
    <div class="row"><button type="button" onClick=${() => ask("disarm")}>End the study</button></div>
    <p>Keep this page open. If it is closed, the study ends at 0 V.</p>`;
}
