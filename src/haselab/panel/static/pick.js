// Points, a ruler and a region on a frame of a video, for haselab track.
import { html, useState, useEffect, useLayoutEffect, useMemo, useRef } from "/static/vendor/htm-preact.js";
import { numberOf, useNumber } from "/static/number.js";
import { unsaved } from "/static/requests.js";

const REACH = { mouse: 12, touch: 24, pen: 16 }; // to a mark, in px of the screen
const SNAP = 24; // to a dot, in px of the screen
const PAIRS = { ruler: "Scale", region: "Region" };
const EMPTY = { marks: [], length: "", number: 0 };
const kept = { video: "", work: { past: [], now: EMPTY, future: [] } }; // while another page is shown

const fixed = (value) => Number(value.toFixed(3));
const inside = (x, y, picture) => ({
  x: fixed(Math.min(Math.max(x, 0), picture.width - 1)), y: fixed(Math.min(Math.max(y, 0), picture.height - 1)),
});

// Where the picture is shown: its middle and the width that is seen, in px of the picture.
function useView(picture, frame) {
  const [view, setView] = useState(null);
  const [wide, setWide] = useState(600);
  useLayoutEffect(() => {
    if (!frame.current) return undefined;
    const seen = new ResizeObserver(() => setWide(frame.current?.clientWidth || 600));
    seen.observe(frame.current);
    return () => seen.disconnect();
  }, [picture !== null]);
  const whole = picture ? { x: picture.width / 2 - 0.5, y: picture.height / 2 - 0.5, w: picture.width } : { x: 0, y: 0, w: 1 };
  const now = view ?? whole;
  const h = picture ? (now.w * picture.height) / picture.width : 1;
  const bounded = ({ x, y, w }) => {
    const width = Math.min(Math.max(w, 8), picture.width), height = (width * picture.height) / picture.width;
    const keep = (at, half, size) => Math.min(Math.max(at, half - 0.5), size - 0.5 - half);
    return { x: keep(x, width / 2, picture.width), y: keep(y, height / 2, picture.height), w: width };
  };
  return {
    ...now, h, pixel: now.w / wide, // px of the picture in a px of the screen
    box: [now.x - now.w / 2, now.y - h / 2, now.w, h],
    whole: () => setView(null),
    move: (dx, dy) => setView((old) => bounded({ ...(old ?? whole), x: (old ?? whole).x + dx, y: (old ?? whole).y + dy })),
    zoom: (factor, at) => setView((old) => {
      const last = old ?? whole, point = at ?? last, w = Math.min(Math.max(last.w * factor, 8), picture.width), share = w / last.w;
      return bounded({ x: point.x + (last.x - point.x) * share, y: point.y + (last.y - point.y) * share, w });
    }),
    place: (event) => {
      const box = frame.current.getBoundingClientRect();
      return { x: now.x + now.w * ((event.clientX - box.left) / box.width - 0.5), y: now.y + h * ((event.clientY - box.top) / box.height - 0.5) };
    },
  };
}

function noteUnsaved() {
  const { marks } = kept.work.now;
  if (marks.length > 0 && marks !== kept.saved) unsaved.add("points"); else unsaved.delete("points");
}

// What was picked, with undo and redo. `change(make, join)`: with join, it is one step with the last change.
function useWork() {
  const [work, setWork] = useState(kept.work);
  const latest = useRef(work);
  const put = (next) => { latest.current = kept.work = next; setWork(next); noteUnsaved(); };
  return {
    ...work.now, canUndo: work.past.length > 0, canRedo: work.future.length > 0,
    latest: () => latest.current.now,
    change: (make, join = false) => {
      const { past, now } = latest.current, next = make(now);
      if (next !== now) put({ past: join ? past : [...past, now].slice(-500), now: next, future: [] });
    },
    undo: () => {
      const { past, now, future } = latest.current;
      if (past.length) put({ past: past.slice(0, -1), now: past.at(-1), future: [now, ...future] });
    },
    redo: () => {
      const { past, now, future } = latest.current;
      if (future.length) put({ past: [...past, now], now: future[0], future: future.slice(1) });
    },
    clear: () => put({ past: [], now: EMPTY, future: [] }),
  };
}

function freeName(marks, wish = "") {
  const used = new Set(marks.map((one) => one.name));
  if (wish && !used.has(wish)) return wish;
  let number = 0;
  while (used.has(`p${number}`)) number += 1;
  return `p${number}`;
}

// Add a mark; a third end of a ruler, or a third corner, begins a new one.
function withMark(work, kind, at, name) {
  const id = work.number + 1;
  let marks = work.marks;
  if (kind in PAIRS && marks.filter((one) => one.kind === kind).length > 1) marks = marks.filter((one) => one.kind !== kind);
  const ends = marks.filter((one) => one.kind === kind).length;
  const label = kind in PAIRS ? `${PAIRS[kind]} ${ends + 1}` : freeName(marks, name);
  return { ...work, number: id, marks: [...marks, { id, kind, name: label, ...at }] };
}

const moved = (id, at) => (work) => ({ ...work, marks: work.marks.map((one) => (one.id === id ? { ...one, ...at } : one)) });

function Mark({ mark, pixel, chosen, faint, named }) {
  const size = 7 * pixel, shape = mark.kind === "point"
    ? html`<circle cx=${mark.x} cy=${mark.y} r=${size} />` : html`<rect x=${mark.x - size} y=${mark.y - size} width=${2 * size} height=${2 * size} />`;
  const cross = html`<path d=${`M${mark.x - 1.6 * size} ${mark.y}h${3.2 * size}M${mark.x} ${mark.y - 1.6 * size}v${3.2 * size}`} />`;
  return html`<g class=${`mark ${mark.kind} ${chosen ? "chosen" : ""} ${faint ? "faint" : ""}`}>
    <g class="halo">${shape}${cross}</g>${shape}${cross}
    ${mark.kind === "point" && (named || chosen) && html`<text x=${mark.x + 2 * size} y=${mark.y - size} font-size=${14 * pixel}>${mark.name}</text>`}</g>`;
}

function Picture({ picture, index, work, chosen, choose, mode, add, drawn, settle, view, frame }) {
  const pointers = useRef(new Map());
  const action = useRef(null);
  const pair = (kind) => work.marks.filter((one) => one.kind === kind);
  const [ruler, region] = [pair("ruler"), pair("region")];

  function nearest(event) {
    const at = view.place(event), reach = (REACH[event.pointerType] ?? 16) * view.pixel;
    const away = (one) => Math.hypot(one.x - at.x, one.y - at.y);
    // Of the chosen kind alone: the ends of a ruler are often at points.
    const near = work.marks.filter((one) => one.kind === mode && away(one) < reach && (index === 0 || mode === "ruler"));
    return near.sort((a, b) => away(a) - away(b))[0] ?? null;
  }
  function down(event) {
    if (event.button > 0) return;
    frame.current.focus({ preventScroll: true });
    frame.current.setPointerCapture(event.pointerId);
    pointers.current.set(event.pointerId, event);
    if (pointers.current.size > 1) { action.current = { what: "pinch" }; return; }
    const mark = nearest(event);
    if (mark) choose(mark.id);
    action.current = { what: mark ? "mark" : "empty", id: mark?.id, from: event, at: view.place(event), offset: mark && { x: mark.x - view.place(event).x, y: mark.y - view.place(event).y }, far: false };
  }
  function move(event) {
    const last = pointers.current.get(event.pointerId), now = action.current;
    if (!last || !now) return;
    pointers.current.set(event.pointerId, event);
    if (now.what === "pinch") {
      const other = [...pointers.current.values()].find((one) => one.pointerId !== event.pointerId);
      if (!other) return;
      const apart = (one) => Math.hypot(one.clientX - other.clientX, one.clientY - other.clientY);
      view.zoom(apart(last) / Math.max(apart(event), 1), view.place({ clientX: (event.clientX + other.clientX) / 2, clientY: (event.clientY + other.clientY) / 2 }));
      view.move(((last.clientX - event.clientX) * view.pixel) / 2, ((last.clientY - event.clientY) * view.pixel) / 2);
      return;
    }
    if (!now.far && Math.hypot(event.clientX - now.from.clientX, event.clientY - now.from.clientY) < 4) return;
    const at = view.place(event);
    if (now.what === "mark") work.change(moved(now.id, inside(at.x + now.offset.x, at.y + now.offset.y, picture)), now.far);
    else if (mode in PAIRS) now.id = drawn(mode, now.id ?? null, now.at, at);
    else view.move((last.clientX - event.clientX) * view.pixel, (last.clientY - event.clientY) * view.pixel);
    now.far = true;
  }
  function up(event) {
    const now = action.current;
    pointers.current.delete(event.pointerId);
    if (pointers.current.size === 0) action.current = null;
    if (event.type !== "pointerup" || !now || now.what === "pinch") return;
    if (now.what === "empty" && !now.far) add(now.at);
    else if (now.far && now.id) settle(now.what === "mark" ? [now.id] : [now.id - 1, now.id]);
  }
  function wheel(event) {
    event.preventDefault();
    view.zoom(Math.exp(event.deltaY * 0.0015), view.place(event));
  }
  function key(event) {
    const steps = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };
    const mark = work.marks.find((one) => one.id === chosen), control = event.ctrlKey || event.metaKey;
    if (event.key in steps && !control && !event.altKey) {
      const [dx, dy] = steps[event.key], step = event.shiftKey ? 0.1 : 1;
      if (mark) work.change(moved(mark.id, inside(mark.x + dx * step, mark.y + dy * step, picture)), event.repeat);
      else view.move(0.1 * view.w * dx, 0.1 * view.h * dy);
    } else if ((event.key === "Delete" || event.key === "Backspace") && mark) {
      work.change((old) => ({ ...old, marks: old.marks.filter((one) => one.id !== mark.id) }));
    } else if (event.key === "+" || event.key === "=") view.zoom(0.7, mark);
    else if (event.key === "-") view.zoom(1 / 0.7, mark);
    else if (event.key === "0") view.whole();
    else if (event.key === "Enter") add({ x: view.x, y: view.y });
    else if (event.key === "s" && mark && !control) settle([mark.id], true);
    else if (event.key === "d" && !control) choose(null);
    else return;
    event.preventDefault();
  }
  const line = { x1: ruler[0]?.x, y1: ruler[0]?.y, x2: ruler[1]?.x, y2: ruler[1]?.y };
  const middle = 10 * view.pixel, few = work.marks.length * (view.w / picture.width) < 15; // else names would hide the dots
  return html`<div class="frame" ref=${frame} tabindex="0" role="application" aria-label="Picture with marks" aria-describedby="pick-keys"
      style=${`aspect-ratio: ${picture.width} / ${picture.height}; max-width: calc(75vh * ${picture.width / picture.height})`}
      onPointerDown=${down} onPointerMove=${move} onPointerUp=${up} onPointerCancel=${up} onWheel=${wheel} onKeyDown=${key}>
    <svg aria-hidden="true" viewBox=${view.box.join(" ")} preserveAspectRatio="none">
      <image href=${picture.picture} x="-0.5" y="-0.5" width=${picture.width} height=${picture.height} preserveAspectRatio="none" />
      ${region.length > 1 && html`<rect class="area" x=${Math.min(region[0].x, region[1].x)} y=${Math.min(region[0].y, region[1].y)} width=${Math.abs(region[1].x - region[0].x)} height=${Math.abs(region[1].y - region[0].y)} />`}
      ${ruler.length > 1 && html`<line class="halo" ...${line} /><line class="line" ...${line} />`}
      ${work.marks.map((mark) => html`<${Mark} key=${mark.id} mark=${mark} pixel=${view.pixel} chosen=${mark.id === chosen} faint=${index > 0 && mark.kind !== "ruler"}
        named=${few || !/^p\d+$/.test(mark.name)} />`)}
      <path class="middle" d=${`M${view.x - middle} ${view.y}h${2 * middle}M${view.x} ${view.y - middle}v${2 * middle}`} />
    </svg></div>`;
}

function Chosen({ mark, work, picture, remove }) {
  const put = (at) => work.change(moved(mark.id, at));
  const moveTo = (axis) => (value) => put(inside(axis === "x" ? value : mark.x, axis === "y" ? value : mark.y, picture));
  const [x, y] = ["x", "y"].map((axis) => useNumber(String(mark[axis]), { step: 0.1, least: 0, enter: moveTo(axis), stepped: moveTo(axis), leave: "commit" }));
  return html`<div role="group" aria-label="Selected mark">
    ${mark.kind === "point" ? html`<label>Name <input type="text" maxlength="60" value=${mark.name} onChange=${(e) => put({ name: e.target.value })} /></label>` : html`<p>${mark.name}</p>`}
    <div class="row"><label>x, in px <input ...${x.field} /></label><label>y, in px <input ...${y.field} /></label><button type="button" onClick=${remove}>Delete</button></div>${x.line}${y.line}</div>`;
}

function Picker({ link, isArmed }) {
  const [list, setList] = useState(null);
  const [video, setVideo] = useState(kept.video);
  const [index, setIndex] = useState(0);
  const [picture, setPicture] = useState(null);
  const [mode, setMode] = useState("point");
  const [snaps, setSnaps] = useState(true);
  const [chosen, choose] = useState(null);
  const [count, setCount] = useState("300");
  const [table, setTable] = useState("");
  const [noName, setNoName] = useState(false); // Save was pressed without a file name
  const [moveAside, setMoveAside] = useState(false);
  const [scale, setScale] = useState("");
  const [scaleError, setScaleError] = useState(""); // also of the answer to Save; shown once
  const [said, say] = useState({ text: "", bad: false });
  const [done, setDone] = useState(null);
  const [pending, setPending] = useState(0); // searches for dots without an answer yet
  const searches = useRef(0);
  const wanted = useRef(null);
  const frame = useRef(null);
  const nameField = useRef(null);
  const card = useRef(null), note = useRef(null);
  const work = useWork();
  const view = useView(picture, frame);
  const fail = (found) => { say({ text: found.error, bad: true }); return null; };
  const pair = (kind) => work.latest().marks.filter((one) => one.kind === kind);

  // One frame is requested at a time; while it is loaded, only the newest wish is kept.
  async function show(name, number) {
    const busy = wanted.current !== null;
    wanted.current = { name, number };
    if (busy) return;
    while (true) {
      const wish = wanted.current;
      const found = await link.request("pick-frame", { video: wish.name, frame: wish.number });
      if (found.error) { fail(found); if (wish.number === 0) setPicture(null); }
      else { setPicture(found); setIndex(wish.number); setTable((old) => old || found.table); say({ text: "", bad: false }); }
      if (wish === wanted.current) { wanted.current = null; return; }
    }
  }
  function open(name) {
    if (name !== kept.video) work.clear();
    kept.video = name;
    say({ text: "", bad: false });
    setVideo(name); setTable(""); setNoName(false); setDone(null); setPicture(null); choose(null); view.whole();
    if (name) show(name, 0);
  }
  async function look() {
    const found = await link.request("pick-videos");
    if (found.error) { fail(found); return; }
    setList(found);
    if (found.only) open(found.videos[0]);
    else if (kept.video) open(kept.video);
  }
  useEffect(() => { look(); }, []);

  useEffect(() => {
    const shortcut = (event) => {
      if (!(event.ctrlKey || event.metaKey) || event.target.matches?.("input[type=text]")) return;
      const key = event.key.toLowerCase();
      if (key === "z" && !event.shiftKey) work.undo();
      else if (key === "y" || key === "z") work.redo();
      else return;
      event.preventDefault();
    };
    document.addEventListener("keydown", shortcut);
    return () => document.removeEventListener("keydown", shortcut);
  }, []);

  useEffect(() => { card.current?.scrollIntoView({ block: "nearest" }); }, [done]);
  useEffect(() => { if (said.bad) note.current?.scrollIntoView({ block: "nearest" }); }, [said]);

  const ends = work.marks.filter((one) => one.kind === "ruler");
  const lengthRule = { above: 0 }, distance = numberOf(work.length, lengthRule).value;
  const typedLength = useNumber(work.length, { rule: lengthRule, least: 0, leave: "check", input: (length) => work.change((old) => ({ ...old, length })) });
  const typedCount = useNumber(count, { rule: { low: 1, high: 5000, whole: true }, leave: "check", input: setCount });
  const ruler = ends.length === 2 && distance !== null ? [ends[0].x, ends[0].y, ends[1].x, ends[1].y, distance] : null;
  useEffect(() => {
    setScaleError("");
    if (ruler === null) { setScale(""); return undefined; }
    let current = true;
    link.request("pick-scale", { ruler }).then((found) => {
      if (!current) return;
      const { value, std } = found.scale_mm_per_px ?? {};
      setScaleError(found.error ?? "");
      setScale(found.error ? "" : `${Number(value.toPrecision(6))} ± ${Number(std.toPrecision(2))} mm per px`);
    });
    return () => { current = false; };
  }, [JSON.stringify(ruler)]);

  // An error is about what was there: it ends with the next change.
  useEffect(() => { say((old) => (old.bad ? { text: "", bad: false } : old)); }, [work.marks, work.length, table, moveAside, count, mode]);

  // Until all answers have come, nothing is saved: marks would be missing.
  async function searched(name, values) {
    setPending(++searches.current);
    const found = await link.request(name, values);
    setPending(--searches.current);
    return found;
  }
  // The dot near a place, if there is one and snapping is on.
  async function snapped(at, kind, always = false) {
    const here = { ...inside(at.x, at.y, picture), name: "" };
    if (!(snaps || always) || kind === "region") return here;
    const found = await searched("pick-snap", { video, frame: index, place: [here.x, here.y], reach: SNAP * view.pixel });
    if (found.error) return fail(found);
    say({ text: found.snapped ? "Moved to the centre of the dot." : "There is no dot here that haselab track would find. The mark is where you placed it.", bad: false });
    return { x: fixed(found.place[0]), y: fixed(found.place[1]), name: found.name };
  }
  async function add(at) {
    if (index > 0 && mode !== "ruler") {
      say({ text: `This is frame ${index}. haselab track reads points as positions in the first frame: go to frame 0 to pick them.`, bad: true });
      return;
    }
    const found = await snapped(at, mode);
    if (found === null) return;
    const { name, ...place } = found;
    work.change((old) => withMark(old, mode, place, name));
    choose(work.latest().number);
  }
  // While the pointer draws a ruler or a region: its first end, then its second.
  function drawn(kind, id, from, to) {
    if (index > 0 && kind === "region") return null;
    if (id === null) {
      work.change((old) => withMark(withMark({ ...old, marks: old.marks.filter((one) => one.kind !== kind) }, kind, inside(from.x, from.y, picture)), kind, inside(to.x, to.y, picture)));
      choose(work.latest().number);
    } else work.change(moved(id, inside(to.x, to.y, picture)), true);
    return work.latest().number;
  }
  // After marks were dragged: to the dots under them.
  async function settle(ids, always = false) {
    for (const one of work.latest().marks.filter((each) => ids.includes(each.id))) {
      const found = await snapped(one, one.kind, always);
      if (found) work.change(moved(one.id, { x: found.x, y: found.y }), !always);
    }
  }
  function remove() {
    work.change((old) => ({ ...old, marks: old.marks.filter((one) => one.id !== chosen) }));
  }
  async function find() {
    const most = typedCount.read();
    if (most === null) return;
    const corners = pair("region").flatMap((one) => [one.x, one.y]);
    const found = await searched("pick-region", { video, frame: 0, corners, count: most });
    if (found.error) { fail(found); return; }
    work.change((old) => {
      const free = found.points.filter(([, x, y]) => !old.marks.some((one) => one.kind === "point" && Math.hypot(one.x - x, one.y - y) < 3));
      return free.reduce((now, [name, x, y]) => withMark(now, "point", { x: fixed(x), y: fixed(y) }, name), old);
    });
    say({ text: `${found.points.length} points in the region: ${found.why.join("; ")}.`, bad: false });
  }
  async function save() {
    if (work.length.trim() !== "" && typedLength.read() === null) { fail({ error: "Not saved, because the distance in Scale is not valid." }); return; }
    const isNameless = !list.only && table.trim() === "";
    setNoName(isNameless);
    if (isNameless) { nameField.current?.focus(); return; }
    const points = work.marks.filter((one) => one.kind === "point").map((one) => [one.name, one.x, one.y]);
    const found = await link.request("pick-save", { video, points, ruler, table: list.only ? "" : table, move: moveAside });
    if (found.error) { fail(found); return; }
    say({ text: "", bad: false });
    setDone({ ...found, marks: work.marks, scale }); setMoveAside(false);
    kept.saved = work.marks;
    noteUnsaved();
  }

  if (list === null) return html`<p role=${said.bad ? "alert" : "status"} class=${said.bad ? "error" : ""}>${said.text || "Looking for videos …"}</p>`;
  const searching = pending > 0 ? `Looking for dots: ${pending} ${pending > 1 ? "searches" : "search"} …` : "";
  const message = html`<p role=${said.bad ? "alert" : "status"} class=${said.bad && !searching ? "error" : ""} ref=${note}>${searching || said.text}</p>`;
  const mark = work.marks.find((one) => one.id === chosen);
  const points = work.marks.filter((one) => one.kind === "point");
  const saved = done && done.marks === work.marks && !said.bad && html`<div class="card" role="status" ref=${card}><h2>Saved</h2>
      <p>${done.points} points: <code>${done.path}</code></p>
      ${done.lost.length > 0 && html`<p class="error">Lost already in the next frame: ${done.lost.slice(0, 10).join(", ")}${done.lost.length > 10 ? ` and ${done.lost.length - 10} others` : ""}. Pick them on a dot, or leave them out.</p>`}
      <p>${done.scale_mm_per_px ? `Scale: ${done.scale}. ` : "No scale: lengths stay in pixels. "}Track the points with this command:</p><p><code>${done.command}</code></p></div>`;
  if (done && list.only) return html`${saved}<p>haselab track --pick has ended. Close this page.</p>`;
  return html`
    ${!list.only && html`<label>Video <select value=${video} disabled=${isArmed} onChange=${(e) => open(e.target.value)}>
      <option value="">Choose one of ${list.more ? "the first " : ""}${list.videos.length} below ${list.folder}</option>
      ${list.videos.map((name) => html`<option value=${name}>${name}</option>`)}</select></label>
      ${isArmed && html`<p role="status">While the bench is armed, the list of videos is disabled, because Esc would close the list instead of pressing STOP. Disarm the bench first.</p>`}`}
    ${!list.only && !list.videos.length && html`<p>There is no video below ${list.folder}. Start haselab panel with --runs DIR, or use haselab track --pick VIDEO.</p>`}
    ${picture === null ? message : html`<div class="layout pick">
      <section aria-label="Picture">
        <div class="row" role="group" aria-label="What to pick">
          ${[["point", "Points"], ["ruler", "Scale"], ["region", "Region"]].map(([kind, name]) => html`<button type="button" aria-pressed=${mode === kind} onClick=${() => setMode(kind)}>${name}</button>`)}
          <label><input type="checkbox" checked=${snaps} onChange=${(e) => setSnaps(e.target.checked)} /> Snap to dots</label>
          <button type="button" disabled=${!work.canUndo} onClick=${work.undo}>Undo</button>
          <button type="button" disabled=${!work.canRedo} onClick=${work.redo}>Redo</button>
          <button type="button" aria-label="Zoom in" onClick=${() => view.zoom(0.7, mark)}>+</button>
          <button type="button" aria-label="Zoom out" onClick=${() => view.zoom(1 / 0.7, mark)}>−</button>
          <button type="button" onClick=${view.whole}>Whole picture</button>
        </div>
        <${Picture} ...${{ picture, index, work, chosen, choose, mode, add, drawn, settle, view, frame }} />
        <div class="said">${message}</div>
        <label>Frame ${index} of 0 to ${Math.max(picture.frames - 1, 0)}${picture.time_s === null ? "" : `, ${picture.time_s.toFixed(4)} s`}
          <input type="range" min="0" max=${Math.max(picture.frames - 1, 0)} step="1" value=${index} onInput=${(e) => show(video, Number(e.target.value))} /></label>
        <p id="pick-keys">Choose what to pick. Click or tap to add a mark, drag it to move it. Scroll, pinch, or press + and - to zoom. Arrow keys move the selected mark by 1 px, with Shift by 0.1 px; without
          a selected mark they move the picture. Enter adds a mark in the middle. S moves the selected mark to the nearest dot, Delete removes it, D deselects it. 0 shows the whole picture, Ctrl+Z undoes, Ctrl+Y redoes.</p>
      </section>
      <section class="controls" aria-label="Marks">
        <div class="card selected"><h2>Selected</h2>${mark ? html`<${Chosen} key=${mark.id} ...${{ mark, work, picture, remove }} />` : html`<p>No mark is selected.</p>`}</div>
        <div class="card"><h2>Points: ${points.length}</h2>
          <p>Points whose names begin with upper and lower give the strain.</p>
          <div class="marks">${work.marks.map((one) => html`<button type="button" aria-pressed=${one.id === chosen} onClick=${() => choose(one.id)}>${one.name} <small>${one.x.toFixed(1)}, ${one.y.toFixed(1)}</small></button>`)}</div></div>
        <div class="card"><h2>Scale</h2>
          <p>Press Scale and pick two points at a known distance.</p>
          <label>Distance, in mm <input ...${typedLength.field} /></label>${typedLength.line}
          ${scaleError && scaleError !== said.text && html`<p class="error" role="alert">${scaleError}</p>`}
          <p role="status">${scaleError ? "" : scale || (ends.length < 2 ? `${ends.length} of 2 points picked.` : distance === null ? "Type the distance." : "")}</p></div>
        <div class="card"><h2>Region</h2>
          <p>Press Region and draw a rectangle to find all dots in it.</p>
          <label>At most this many <input ...${typedCount.field} /></label>${typedCount.line}
          <button type="button" disabled=${pair("region").length < 2} onClick=${find}>Find the dots in the region</button></div>
        <div class="card"><h2>Save</h2>
          ${list.only ? html`<p><code>${table}</code></p>` : html`<label>File name of the table <input type="text" value=${table} ref=${nameField} aria-invalid=${noName ? "true" : null} aria-describedby=${noName ? "no-name" : null} onInput=${(e) => { setTable(e.target.value); setNoName(false); }} /></label>
            ${noName && html`<p class="error number" role="alert" id="no-name">Not saved: this field is empty. Type a file name, such as points.csv.</p>`}`}
          <label><input type="checkbox" checked=${moveAside} onChange=${(e) => setMoveAside(e.target.checked)} /> Move an existing file to NAME.previous-1</label>
          <button type="button" disabled=${!points.length || pending > 0} onClick=${save}>Save ${points.length} points</button></div>
        ${saved}
      </section></div>`}`;
}

// The panel draws its pages with every frame of data, but nothing else changes here then.
export default function Pick({ link, state }) {
  const isArmed = Boolean(state?.holder); // an open list would take the key of STOP
  return useMemo(() => html`<${Picker} link=${link} isArmed=${isArmed} />`, [link, isArmed]);
}
