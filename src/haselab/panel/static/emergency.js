// STOP. It depends on nothing else of the page: its own script, port and connection.
"use strict";
(() => {
  const button = document.getElementById("emergency");
  const state = document.getElementById("emergency-state");
  let address = null;
  let pressed = false;

  const show = (text, bad) => {
    if (state.textContent !== text) state.textContent = text;
    state.classList.toggle("bad", bad);
  };

  async function ready() {
    try {
      if (address === null) {
        const about = await (await fetch("/about")).json();
        address = `http://${location.hostname}:${about.stop_port}`;
      }
      const answer = await fetch(`${address}/ready`, { signal: AbortSignal.timeout(2000) });
      if (!answer.ok) throw new Error(answer.statusText);
      if (!pressed) show("STOP: ready", false);
    } catch {
      show("STOP DOES NOT ANSWER. Press the emergency stop of the bench.", true);
    }
    setTimeout(ready, 2000);
  }

  async function stop() {
    pressed = true;
    button.classList.add("pressed");
    show("STOP: sent", false);
    try {
      const answer = await fetch(`${address}/stop`, { method: "POST", keepalive: true });
      const found = await answer.json();
      show(found.commanded ? "STOP: 0 V commanded" : "THE BENCH PROCESS DOES NOT ANSWER. Press the emergency stop of the bench.", !found.commanded);
    } catch {
      show("STOP DOES NOT ANSWER. Press the emergency stop of the bench.", true);
    }
    button.classList.remove("pressed");
    if (!state.classList.contains("bad")) setTimeout(() => { pressed = false; }, 5000); // a failure stays
  }

  button.addEventListener("pointerdown", stop);
  button.addEventListener("keydown", (event) => {
    if ((event.key === "Enter" || event.key === " ") && !event.repeat) stop();
  });
  document.addEventListener("keydown", (event) => {
    if (event.key === "Escape" && !event.repeat) stop();
  }, true);
  ready();
})();
