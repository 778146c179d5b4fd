// STOP depends on nothing else in the page: it has its own script, port and connection. The page
// contains the port, so that STOP works even if the web server hangs right after it has sent the page.
// A press also goes through the connection of the page, in case the process of STOP hangs.
"use strict";
(() => {
  const button = document.getElementById("emergency");
  const state = document.getElementById("emergency-state");
  const address = `http://${location.hostname}:${button.dataset.port}`;
  const ANSWER_MS = 3000; // the stop process waits 2 s for the bench process
  let pressed = false; // its result stays for some seconds
  let unconfirmed = false; // the last press
  let pressedAt = -Infinity;
  let socket = null; // to STOP; a message on it leaves the browser sooner than a request

  const show = (text, bad) => {
    if (state.textContent !== text) state.textContent = text;
    state.classList.toggle("bad", bad);
  };

  const now = () => new Date().toTimeString().slice(0, 8);
  const later = (ms) => new Promise((resolve) => setTimeout(resolve, ms));

  const answers = () => fetch(`${address}/ready`, { signal: AbortSignal.timeout(2000) }).then((answer) => answer.ok, () => false);

  // Why STOP of this page would not work now; empty if it answers.
  window.stopObstacle = async () => (await answers() ? "" : `STOP of this page does not answer at ${address}, so it cannot arm the bench. Restart the panel, or, if this page comes through a tunnel, let that port through, too.`);

  async function ready() {
    if (!await answers()) {
      if (!pressed) show("STOP DOES NOT ANSWER. Press the emergency stop of the bench.", true);
    } else {
      if (socket === null || socket.readyState > WebSocket.OPEN) socket = new WebSocket(`${address.replace("http", "ws")}/socket`);
      if (!pressed) show(unconfirmed ? "STOP: ready again. THE LAST PRESS WAS NOT CONFIRMED." : "STOP: ready", unconfirmed);
    }
    setTimeout(ready, 2000);
  }

  async function stop() {
    if (socket !== null && socket.readyState === WebSocket.OPEN) socket.send("stop");
    const other = (async () => window.stopBesides?.())().catch(() => null); // a fault in it must not keep the rest from running
    pressed = true;
    pressedAt = performance.now();
    button.classList.add("pressed");
    show("STOP: sent", state.classList.contains("bad"));
    try {
      const answer = await fetch(`${address}/stop`, { method: "POST", keepalive: true, signal: AbortSignal.timeout(ANSWER_MS) });
      const found = await answer.json();
      const unsafe = found.fault ? `0 V IS NOT CONFIRMED (${found.fault}).` : "THE BENCH PROCESS DOES NOT ANSWER.";
      unconfirmed = !found.commanded;
      show(found.commanded ? `STOP: 0 V commanded at ${now()}` : `${unsafe} Press the emergency stop of the bench.`, unconfirmed);
    } catch {
      unconfirmed = !(await Promise.race([other, later(500)]))?.answer?.commanded;
      show(unconfirmed ? "STOP DOES NOT ANSWER. Press the emergency stop of the bench." : `0 V commanded at ${now()}, but STOP DOES NOT ANSWER. Restart the panel.`, true);
    }
    button.classList.remove("pressed");
    setTimeout(() => { pressed = false; }, 5000);
  }

  button.addEventListener("pointerdown", stop);
  button.addEventListener("keydown", (event) => {
    if ((event.key === "Enter" || event.key === " ") && !event.repeat) stop();
  });
  // Voice control, screen readers and switch devices send only a click.
  button.addEventListener("click", () => { if (performance.now() - pressedAt > 1000) stop(); });
  // Also for a document in a frame of this page, whose keys do not arrive here.
  window.listenForStop = (place) => place.addEventListener("keydown", (event) => {
    if (event.key === "Escape" && !event.repeat) stop();
  }, true);
  window.listenForStop(document);
  ready();
})();
