// The connection to the web server: frames in, commands out. It watches the age of the data.
import { Requests } from "/static/requests.js";

const SCHEMA = 1;
const SILENT_MS = 900; // without a frame the connection is opened again
const PATIENCE_MS = 20000; // longest wait for a connection: Chromium delays new ones after failures

export class Link extends Requests {
  constructor(onFrame, onChange) {
    super();
    this.onFrame = onFrame;
    this.onChange = onChange;
    this.view = { span_s: 10, end_s: null, columns: 600 };
    this.holder = "";
    this.problem = "";
    this.framedAt = -Infinity;
    this.blockAge = 0; // when the last frame was sent, in s
    this.stateAge = 0; // when the last frame was sent, in s
    this.clock = 0; // of the bench process in the last frame, in s; the process refuses commands with an old time
    this.patience = SILENT_MS; // with a socket that is connecting
    this.waiting = new Map();
    this.number = 0;
    this.open();
    setInterval(() => this.watch(), 100);
    document.addEventListener("visibilitychange", () => this.watch());
  }

  // Of the last block that the bench has read.
  get age_ms() { return this.silent_ms + 1000 * this.blockAge; }

  // Of the state of the bench, which its process also sends without new data.
  get stateAge_ms() { return this.silent_ms + 1000 * this.stateAge; }

  get silent_ms() { return performance.now() - this.framedAt; }

  get wait_ms() { return this.socket.readyState === WebSocket.CONNECTING ? this.patience : SILENT_MS; }

  open() {
    const socket = new WebSocket(`ws://${location.host}/live`);
    this.socket = socket;
    this.openedAt = performance.now();
    socket.binaryType = "arraybuffer";
    socket.onopen = () => {
      if (socket === this.socket) this.openedAt = performance.now();
      socket.send(JSON.stringify({ token: this.token }));
    };
    socket.onmessage = ({ data }) => {
      if (socket !== this.socket) return; // an old connection: its frames are old
      if (typeof data === "string") this.heard(JSON.parse(data));
      else this.framed(data);
    };
    socket.onclose = ({ code, reason }) => {
      if (socket !== this.socket) return;
      if (code === 1008) this.problem = `The server refused this page (${reason || "wrong address"}). Open the address that haselab panel printed.`;
      this.socket = null;
      this.lost();
      this.onChange();
    };
  }

  lost() {
    for (const answer of this.waiting.values()) answer({ error: "The connection was lost before the answer, so the command may have been carried out. Check the state of the bench." });
    this.waiting.clear();
  }

  watch() {
    const since = performance.now() - this.openedAt;
    if (this.socket === null) {
      if (since > 400 && !this.problem) this.open();
    } else if (this.silent_ms > SILENT_MS && since > this.wait_ms) {
      const old = this.socket;
      if (old.readyState === WebSocket.CONNECTING) this.patience = Math.min(2 * this.patience, PATIENCE_MS);
      this.socket = null; // also when the old one never closes
      old.close();
      this.lost();
      this.open();
    }
    this.onChange();
  }

  heard(message) {
    if ("holder" in message) {
      this.holder = message.holder;
      this.send({ view: this.view });
      return;
    }
    const answer = this.waiting.get(message.id);
    this.waiting.delete(message.id);
    if (answer) answer(message);
  }

  framed(buffer) {
    const head = new DataView(buffer);
    if (head.getUint16(0, true) !== SCHEMA) { // no reload of its own: it would lose what is not saved
      this.problem = "The panel was started again with another version. Reload this page.";
      this.socket.close();
      return;
    }
    const number = head.getUint32(4, true);
    const [monitorStart, monitorStep, signalStart, signalStep] = [8, 16, 24, 32].map((at) => head.getFloat64(at, true));
    const size = head.getUint32(40, true), columns = head.getUint32(44, true);
    const about = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 48, size)));
    const values = new Float32Array(buffer.slice(48 + size));
    const rows = (values.length - 4 * columns) / 2 / 5;
    const part = (start, count) => values.subarray(start, start + count);
    const monitors = { start: monitorStart, step: monitorStep, low: [], high: [] };
    for (let k = 0; k < 2; k++) {
      monitors.low.push(part(k * columns, columns));
      monitors.high.push(part((2 + k) * columns, columns));
    }
    const signals = { start: signalStart, step: signalStep, low: [], high: [] };
    for (let k = 0; k < 5; k++) {
      signals.low.push(part(4 * columns + k * rows, rows));
      signals.high.push(part(4 * columns + (5 + k) * rows, rows));
    }
    this.framedAt = performance.now();
    this.patience = SILENT_MS;
    this.blockAge = about.age_s;
    this.stateAge = about.state_age_s;
    this.clock = about.clock_s;
    this.send({ ack: number });
    this.onFrame({ ...about, monitors, signals });
  }

  send(message) {
    if (this.socket && this.socket.readyState === WebSocket.OPEN) this.socket.send(JSON.stringify(message));
  }

  setView(view) {
    this.view = { ...this.view, ...view };
    this.send({ view: this.view });
  }

  ask(what, values = {}) {
    if (!this.socket || this.socket.readyState !== WebSocket.OPEN) {
      return Promise.resolve({ error: "The command was not sent, because there is no connection to the panel." });
    }
    this.number += 1;
    const id = this.number;
    this.send({ id, do: what, values, at_s: this.clock });
    return new Promise((resolve) => this.waiting.set(id, resolve));
  }
}
