// Choose, check and play a study; the list of recordings.
import { html, useState, useEffect, useMemo, useRef } from "/static/vendor/htm-preact.js";
import { Arming, Playing, Progress, Said, fixed, focusLost, kilo, limitOf, othersDo } from "/static/bench.js";

const number = (v) => (v === null || v === undefined ? "" : Number(v.toPrecision(5)));
const clock = new Intl.DateTimeFormat("sv-SE", { dateStyle: "short", timeStyle: "medium" }); // as in the names of the folders
const local = (time) => (Number.isNaN(Date.parse(time)) ? "" : clock.format(new Date(time)));
const when = (s) => (s === null ? "an unknown time" : s < 120 ? `${Math.round(s)} s` : `${Math.round(s / 60)} min`);

let remembered = null; // the choice, while another page of the panel is shown

function Chooser({ link, state, mine, onEnd }) {
  const [list, setList] = useState(null);
  const [chosen, choose] = useState(remembered ?? { study: "", quick: false, experiments: [], keep_video: "sample" });
  const [checked, setChecked] = useState(null);
  const [error, say] = useState("");
  useEffect(() => {
    link.request("studies").then((found) => {
      if (found.error) { say(found.error); return; }
      setList(found.studies);
      const kept = found.studies.some((one) => one.name === remembered?.study);
      if (!kept) pick(found.studies, found.studies[0].name);
    });
  }, []);
  function change(part) { remembered = { ...chosen, ...part }; choose(remembered); setChecked(null); say(""); }
  function pick(studies, name) {
    const found = studies.find((one) => one.name === name);
    change({ study: name, experiments: found.experiments.map((one) => one.table) });
  }
  async function check() {
    setChecked("checking");
    const found = await link.request("check-study", chosen);
    setChecked(found.error ? null : found);
    say(found.error || "");
  }
  const busy = state !== null && state.holder !== "", others = othersDo(state, link);
  useEffect(() => { if (others) say(""); }, [others]);
  const place = useRef(null), isPlaying = busy && state.mode === "study", played = useRef(false);
  useEffect(() => { // at its end
    if (played.current && !isPlaying && focusLost()) place.current?.focus({ preventScroll: true });
    played.current = isPlaying;
  }, [isPlaying]);
  const disarm = () => link.ask("disarm").then((found) => { say(found.error || ""); place.current?.focus(); });
  if (busy && state.mode === "study" && mine) return html`<div class="card warning"><h2>Study</h2>
    <${Said} error=${error} /><${Playing} state=${state} link=${link} say=${say} /></div>`;
  if (busy && state.mode === "study") return html`<div class="card warning"><h2>Study</h2>
    <p class="badge live">Another page plays a study, up to ${limitOf(state)}</p><${Progress} state=${state} /></div>`;
  if (list === null) return html`<div class="card"><h2>Study</h2><p class=${error ? "error" : ""} role="status">${error || "Reading the studies …"}</p></div>`;
  const blocked = busy && html`<div class="row" role="status"><span>${mine ? "This page has armed the bench. Disarm it before you play a study." : "The bench is armed by another page. Disarm it there before you play a study."} Until then the list of studies is disabled, because Esc would close the list instead of pressing STOP.</span>${mine && html`<button type="button" onClick=${disarm}>Disarm</button>`}</div>`;
  const titles = list.find((one) => one.name === chosen.study)?.experiments ?? [];
  const toggle = (table, on) => change({ experiments: titles.map((one) => one.table).filter((one) => (one === table ? on : chosen.experiments.includes(one))) });
  // Planned on the clock of the bench; a file that cannot be planned has none.
  const seconds = titles.filter((one) => chosen.experiments.includes(one.table)).map((one) => one.seconds[Number(chosen.quick)] ?? null);
  const total = seconds.includes(null) ? null : seconds.reduce((sum, one) => sum + one, 0);
  const fast = state?.simulated ? " This simulated bench plays it as fast as this computer can." : "";
  return html`<div class="card"><h2>Study</h2>
    <${Said} error=${error} />
    ${blocked}
    ${state?.reason && html`<p role="status">Last message of the bench: ${state.reason}</p>`}
    <label>Study <select value=${chosen.study} disabled=${busy} onChange=${(e) => pick(list, e.target.value)}>
      ${list.map((one) => html`<option value=${one.name}>${one.name}</option>`)}</select></label>
    <fieldset><legend>Experiments</legend>
      <div class="row"><button type="button" onClick=${() => change({ experiments: titles.map((one) => one.table) })}>All</button>
        <button type="button" onClick=${() => change({ experiments: [] })}>None</button></div>
      ${titles.map((one) => html`<label><input type="checkbox" checked=${chosen.experiments.includes(one.table)}
        onChange=${(e) => toggle(one.table, e.target.checked)} /> ${one.title} (${one.table})${typeof one.seconds[Number(chosen.quick)] === "number" ? `: ${when(one.seconds[Number(chosen.quick)])}` : ""}</label>`)}</fieldset>
    <label><input type="checkbox" checked=${chosen.quick} onChange=${(e) => change({ quick: e.target.checked })} /> Short version</label>
    <label><input type="checkbox" checked=${chosen.keep_video === "none"} onChange=${(e) => change({ keep_video: e.target.checked ? "none" : "sample" })} /> Keep no camera frames</label>
    ${seconds.length > 0 && total !== null && html`<p>Planned duration of all: ${when(total)}.${fast}</p>`}
    <div class="row"><button type="button" ref=${place} disabled=${checked === "checking" || chosen.experiments.length === 0} onClick=${check}>Check, then play …</button>
      ${chosen.experiments.length === 0 && html`<span>Tick an experiment first.</span>`}</div>
    ${checked === "checking" && html`<p role="status">Checking the study against the limits of the bench …</p>`}
    ${checked !== null && checked !== "checking" && html`
      <p role="status">${!checked.rated ? "The rating of this bench is not known (the rig file has no [rating]), so the study was not checked against it."
        : checked.ok ? `The bench can play this study. Its planned duration is ${checked.seconds === null ? "not known" : when(checked.seconds)}. Its highest drive is ${kilo(checked.highest_v, state?.gain ?? 1)}.` : "The bench cannot play this study."}</p>
      ${checked.ok && busy && html`<p>The bench is armed: disarm it first, see above.</p>`}
      ${checked.ok && !busy && state && html`<${Arming} state=${state} link=${link} say=${say} study=${{ ...chosen, sha256: checked.sha256 }} needs=${checked.highest_v ?? 0} onArmed=${() => setChecked(null)} />`}
      ${checked.checks.length > 0 && html`<table class="wide"><thead><tr><th scope="col">Check</th><th scope="col">Where</th><th scope="col">Needed</th><th scope="col">Limit</th><th scope="col">What to do</th></tr></thead>
        <tbody>${checked.checks.map((one) => html`<tr><td data-label="Check">${one.name}</td><td data-label="Where">${one.where}</td><td data-label="Needed" class=${one.ok ? "" : "error"}>${number(one.requested)} ${one.unit}</td>
          <td data-label="Limit">${number(one.limit)} ${one.unit}</td><td data-label="What to do">${one.ok ? "nothing" : one.advice}</td></tr>`)}</tbody></table>`}`}
  </div>`;
}

function Comparison({ link, names, close }) {
  const [found, see] = useState(null);
  useEffect(() => { link.request("compare", { first: names[0], second: names[1] }).then(see); }, [names.join()]);
  if (found === null) return html`<p role="status">Comparing …</p>`;
  if (found.error) return html`<p class="error" role="alert">${found.error}</p>`;
  const cell = (one) => (one === null ? "–" : html`${number(one.value)} <small>[${number(one.ci95[0])}, ${number(one.ci95[1])}]</small>`);
  return html`<div class="card"><h2>Comparison</h2><p>Difference: ${names[1]} minus ${names[0]}, divided by their combined standard deviation. A red value is larger than noise explains: 0 is outside the 95 % interval of the difference, and the value is beyond ${fixed(found.limit, 1)}, which the largest of so many rows exceeds by noise alone in 5 % of comparisons.</p>
    ${found.notes.map((one) => html`<p>Note: ${one}.</p>`)}
    <button type="button" onClick=${close}>Close</button>
    <table class="wide"><thead><tr><th scope="col">Row</th><th scope="col">Name</th><th scope="col">Unit</th><th scope="col">${names[0]}</th><th scope="col">${names[1]}</th><th scope="col">Difference</th></tr></thead>
    <tbody>${found.rows.map((one) => html`<tr><td data-label="Row">${one.id}</td><td data-label="Name">${one.name}</td><td data-label="Unit">${one.unit}</td><td data-label=${names[0]}>${cell(one.first)}</td><td data-label=${names[1]}>${cell(one.second)}</td>
      <td data-label="Difference" class=${one.exceeds ? "error" : ""}>${one.deviations === null ? "–" : fixed(one.deviations, 1)}</td></tr>`)}</tbody></table></div>`;
}

const drafts = new Map(); // notes that are typed and not saved, by recording, with the note that was shown before

// A note about a recording. Only what somebody typed is saved, and only over the note that they saw.
function Note({ name, saved, keep }) {
  const [draft, set] = useState(drafts.get(name) ?? null);
  const change = (next) => { if (next === null) drafts.delete(name); else drafts.set(name, next); set(next); };
  const type = (text) => { say(""); change({ text, before: draft === null ? saved : draft.before }); };
  const differs = draft !== null && draft.before !== saved && draft.text !== saved;
  const sending = useRef(null); // the button takes the focus from the field, which saves as well
  const [said, say] = useState("");
  async function save(before) {
    const sent = draft.text;
    if (sending.current === sent) return;
    sending.current = sent;
    const error = sent === before ? "" : await keep(name, sent, before);
    sending.current = null;
    say(error || "Saved.");
    if (error) return;
    if (drafts.get(name)?.text === sent) change(null); // nobody typed meanwhile
    else change({ ...drafts.get(name), before: sent });
  }
  const isTyped = draft !== null && !differs && draft.text !== saved;
  return html`<textarea aria-label=${`Note about ${name}`} rows="2" value=${draft === null ? saved : draft.text} onInput=${(e) => type(e.target.value)}
      onBlur=${() => draft !== null && !differs && save(saved)}></textarea>
    ${isTyped && html`<button type="button" onClick=${() => save(saved)}>Save</button>`}
    ${said && html`<p class=${said === "Saved." ? "" : "error"} role=${said === "Saved." ? "status" : "alert"}>${said}</p>`}
    ${differs && html`<p class="error" role="alert">Not saved: meanwhile, the note was changed to “${saved}”.</p>
      <div class="row"><button type="button" onClick=${() => save(saved)}>Save what I typed instead</button>
        <button type="button" onClick=${() => change(null)}>Discard what I typed</button></div>`}`;
}

// A report, in this page, so that STOP stays in view; it has no scripts, and none would run.
function Report({ name, text, close }) {
  const place = useRef(null);
  const [lost, lose] = useState(false);
  const address = useMemo(() => URL.createObjectURL(new Blob([text], { type: "text/html" })), []);
  useEffect(() => {
    const before = document.activeElement;
    place.current.scrollIntoView();
    place.current.focus({ preventScroll: true });
    return () => { URL.revokeObjectURL(address); before?.focus(); }; // on the button that has opened it
  }, []);
  // Esc must press STOP also while the focus is in the report: nothing else may take the keys there.
  function loaded({ target }) {
    const found = target.contentDocument;
    if (!found?.URL.startsWith(address)) { lose(true); place.current.focus(); return; }
    found.querySelectorAll("iframe, frame, object, embed, select, input, textarea").forEach((one) => one.remove());
    window.listenForStop(found);
    // A browser would also scroll this page to the place of a link in the report.
    found.addEventListener("click", (event) => {
      const aim = event.target.closest?.("a[href^='#']"), to = aim && found.getElementById(decodeURIComponent(aim.hash.slice(1)));
      if (!aim) return;
      event.preventDefault();
      if (!to) return;
      found.defaultView.scrollTo(0, found.defaultView.scrollY + to.getBoundingClientRect().top);
      to.tabIndex = -1;
      to.focus({ preventScroll: true });
    });
  }
  return html`<div class="card report"><h2 ref=${place} tabindex="-1">Report of ${name}</h2>
    <div class="row"><button type="button" onClick=${close}>Close the report</button>
      <span>For a tab of its own, open report.html in the folder of the recording.</span></div>
    ${lost ? html`<p class="error" role="alert">A link in the report led elsewhere, which this page does not show. Close the report, and open it again.</p>`
      : html`<iframe title=${`Report of ${name}`} sandbox="allow-same-origin" src=${address} onLoad=${loaded}></iframe>`}</div>`;
}

const MOST_ROWS = 100; // more are drawn on request: thousands would block the page, and the bench would be lost

function Recordings({ link, mode, recording }) {
  const [most, setMost] = useState(MOST_ROWS);
  const [found, see] = useState({ folder: "", recordings: [] });
  const [search, setSearch] = useState("");
  const [marked, mark] = useState([]);
  const [compared, setCompared] = useState(null);
  const [error, say] = useState("");
  const read = () => link.request("recordings").then((list) => (list.error ? say(list.error) : see(list)));
  useEffect(() => {
    let timer = null, over = false;
    const repeat = async () => { await read(); if (!over) timer = setTimeout(repeat, 3000); }; // one request at a time
    repeat();
    return () => { over = true; clearTimeout(timer); };
  }, []);
  useEffect(() => { if (mode !== undefined) read(); }, [mode]);
  const [shown, show] = useState(null);
  async function open(name) {
    const answer = await link.request("report", { name });
    say(answer.error || "");
    show(answer.error ? null : { name, text: answer.html, at: performance.now() });
  }
  async function analyse(name) {
    const answer = await link.request("analyse", { name });
    say(answer.error || "");
    read();
  }
  async function keep(name, text, before) {
    const answer = await link.request("note", { name, text, before });
    await read();
    return answer.error || "";
  }
  const wanted = search.toLowerCase().split(/\s+/).filter(Boolean);
  const all = wanted.length === 0 ? found.recordings : found.recordings.filter((one) => {
    const text = `${one.name} ${one.study} ${local(one.opened)} ${one.state} ${one.note}`.toLowerCase();
    return wanted.every((word) => text.includes(word));
  });
  const toggle = (name, on) => mark(on ? [...marked, name].slice(-2) : marked.filter((one) => one !== name));
  return html`${shown && html`<${Report} key=${shown.at} name=${shown.name} text=${shown.text} close=${() => show(null)} />`}
    ${compared && html`<${Comparison} link=${link} names=${compared} close=${() => setCompared(null)} />`}
    <div class="card"><h2>Recordings</h2>
    ${error && html`<p class="error" role="alert">${error}</p>`}
    <p>${found.recordings.length} in ${found.folder}${found.is_there === false ? ", which does not exist" : ""}</p>
    <label>Search <input type="search" value=${search} onInput=${(e) => setSearch(e.target.value)} /></label>
    <div class="row"><button type="button" disabled=${marked.length !== 2} onClick=${() => setCompared(marked)}>Compare the two that are marked</button></div>
    <table class="wide"><thead><tr><th scope="col">Mark</th><th scope="col">Recording</th><th scope="col">Study</th><th scope="col">Ended</th><th scope="col">Note</th><th scope="col">Results</th></tr></thead>
    <tbody>${all.slice(0, most).map((one) => html`<tr key=${one.name}>
      <td data-label="Mark"><input type="checkbox" aria-label=${`Mark ${one.name}`} checked=${marked.includes(one.name)} onChange=${(e) => toggle(one.name, e.target.checked)} /></td>
      <td data-label="Recording">${one.name}<br /><small>${local(one.opened)}</small></td><td data-label="Study">${one.study}</td><td data-label="Ended">${one.name === recording ? "being recorded" : one.state}</td>
      <td data-label="Note"><${Note} name=${one.name} saved=${one.note} keep=${keep} /></td>
      <td data-label="Results"><div class="row">${one.report ? html`<button type="button" onClick=${() => open(one.name)}>Report</button>` : ""}
        <button type="button" disabled=${one.analysing || one.open} onClick=${() => analyse(one.name)}>${one.analysing ? "Analysing …" : "Analyse"}</button></div>
        ${one.open && one.name !== recording && html`<p>Run haselab recover on its folder before you analyse it.</p>`}
        ${one.state && !one.open && !one.report && !one.problem && !/^(complete|recovered)/.test(one.state) && html`<p>This study ended early. It can be analysed only if all of its recorded experiments are complete.</p>`}
        ${one.problem && html`<p class="error">${one.problem}</p>`}</td></tr>`)}</tbody></table>
    ${all.length === 0 && wanted.length > 0 && html`<p role="status">No recording contains “${search.trim()}” in its name, study, date, end or note.</p>`}
    ${all.length > most && html`<p>The newest ${most} of ${all.length} are shown.</p><button type="button" onClick=${() => setMost(most + MOST_ROWS)}>Show more</button>`}</div>`;
}

export default function Studies({ link, state, mine }) {
  const mode = state?.mode, recording = state?.recording;
  // The panel draws its pages with every frame of data, but the list does not depend on it.
  const list = useMemo(() => html`<${Recordings} link=${link} mode=${mode} recording=${recording} />`, [link, mode, recording]);
  return html`<${Chooser} link=${link} state=${state} mine=${mine} />${list}`;
}
