// Number fields. Not type="number": there a browser drops a decimal comma without a word, and "0,2" becomes 2.
import { html, useState, useRef } from "/static/vendor/htm-preact.js";

const NUMBER = /^[+-]?(\d+\.?\d*|\.\d+)(e[+-]?\d+)?$/i;
const BEGUN = /^\s*[+-]?(\d*\.?\d*|(\d+\.?\d*|\.\d+)e[+-]?\d*)\s*$/i; // of a number that is being typed
const COMMA = /^[+-]?\d*,\d+(e[+-]?\d+)?$/i;
let fields = 0;

// The distance of the steps of a slider, a power of ten, and its ends on whole steps within the limits.
export function stepsOf(low, high, few = 20) {
  const power = Math.floor(Math.log10(Math.max((high - low) / few, 1e-9)) + 1e-9), step = 10 ** power;
  const round = (count) => Number((count * step).toFixed(Math.max(-power, 0)));
  return { step: round(1), min: round(Math.ceil(low / step - 1e-6)), max: round(Math.floor(high / step + 1e-6)) };
}

const HANDLE_PX = 28; // from the middle of a handle: a finger is on it

// A slider that a finger moves only by its handle: a swipe that scrolls the page may begin anywhere on it.
export function Range({ value, put, ...rest }) {
  const held = useRef(true);
  function down({ target, pointerType, clientX }) {
    const box = target.getBoundingClientRect(), share = (target.value - target.min) / (target.max - target.min);
    const handle = box.left + 8 + share * (box.width - 16);
    held.current = pointerType !== "touch" || Math.abs(clientX - handle) <= HANDLE_PX;
  }
  function moved({ target }) {
    if (held.current) put(Number(target.value));
    else target.value = value;
  }
  return html`<input type="range" value=${value} ...${rest} onPointerDown=${down} onKeyDown=${() => { held.current = true; }} onInput=${moved} />`;
}

// The number in a text, or what is wrong with the text.
export function numberOf(text, { low = -Infinity, high = Infinity, above = -Infinity, whole = false } = {}) {
  const word = text.trim(), value = Number(word), wrong = (problem) => ({ value: null, problem });
  if (word === "") return wrong("This field is empty. Type a number, such as 0.2.");
  if (COMMA.test(word)) return wrong(`${word} is not a number. Write a decimal point: ${word.replace(",", ".").replace(/^([+-]?)\./, "$10.")}.`);
  if (!NUMBER.test(word)) return wrong(`${word} is not a number. Type one number without a unit, such as 0.2.`);
  if (!Number.isFinite(value)) return wrong(`${word} is too large. Type a smaller number.`);
  if (whole && !Number.isInteger(value)) return wrong(`${word} is not a whole number. Type one, such as ${Math.round(value)}.`);
  if (value < low) return wrong(`${word} is too low. Type at least ${low}.`);
  if (value > high) return wrong(`${word} is too high. Type at most ${high}.`);
  if (!(value > above)) return wrong(`${word} is too low. Type a number above ${above}.`);
  return { value, problem: "" };
}

// A field that shows the text `shown` while nobody types: the attributes of its input, the line about a
// wrong number, and `read`, which returns the number, or null with this line. `enter` gets what was typed.
// `leave`: what happens when the focus leaves the field. `input`: it gets each text. Arrow keys change the
// number by `step` from `least` to `most`; `stepped` gets it. `refused`: why the bench refused the last number; the
// field calls `begun` when another one is typed.
export function useNumber(shown, { rule = {}, step = 1, least = rule.low ?? -Infinity, most = rule.high ?? Infinity, enter, leave, input, stepped, refused = "", begun } = {}) {
  const [typed, type] = useState(null);
  const [asked, ask] = useState(false); // whether somebody wanted the number
  const id = useRef("");
  if (id.current === "") id.current = `number-${++fields}`;
  const text = typed ?? shown, found = numberOf(text, rule);
  const problem = (asked || !BEGUN.test(text) ? found.problem : "") || refused;
  const put = (next) => { ask(false); begun?.(); if (input) input(next); else type(next); };
  const reset = () => { ask(false); type(null); };
  const read = () => { ask(found.value === null); return found.value; };
  function commit() {
    if (typed === null || !enter) return;
    const value = read();
    if (value !== null) { enter(value); type(null); }
  }
  function key(event) {
    const sign = { ArrowUp: 1, ArrowDown: -1 }[event.key];
    if (event.key === "Enter") commit();
    if (sign === undefined || event.ctrlKey || event.altKey || event.metaKey) return;
    event.preventDefault();
    const before = text.trim() === "" ? 0 : numberOf(text).value;
    if (before === null) return;
    const value = Number((before + sign * step).toPrecision(12)), next = Math.min(Math.max(value, least), most);
    if (sign * (next - before) <= 0) return;
    if (stepped) { reset(); stepped(next); } else put(String(next));
  }
  return {
    text, read,
    field: {
      type: "text", inputmode: "decimal", autocomplete: "off", value: text, "aria-invalid": problem ? "true" : null, "aria-describedby": problem ? id.current : null,
      onInput: (event) => put(event.target.value), onKeyDown: key, onBlur: { commit, reset, check: () => text.trim() !== "" && read() }[leave],
    },
    line: problem && html`<p class="error number" role="alert" id=${id.current}>${problem}</p>`,
  };
}
