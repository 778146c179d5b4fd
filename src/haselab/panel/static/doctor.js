// What haselab doctor finds on this computer and its bench.
import { html, useState, useEffect } from "/static/vendor/htm-preact.js";

export default function Doctor({ link }) {
  const [found, see] = useState(null);
  async function examine() {
    see(null);
    see(await link.request("doctor"));
  }
  useEffect(() => { examine(); }, []);
  if (found === null) return html`<p role="status">Checking this computer …</p>`;
  if (found.error) return html`<p class="error" role="alert">${found.error}</p><button type="button" onClick=${examine}>Check again</button>`;
  const lacking = found.findings.filter((one) => !one.found);
  const rest = found.findings.filter((one) => one.found);
  const rows = (list) => list.map((one) => html`<tr><td data-label="Kind">${one.kind}</td><td data-label="Name">${one.name}</td>
    <td data-label="Found">${one.found ? "" : html`<strong class="error">missing or no answer</strong> `}${one.detail}</td><td data-label="What to do">${one.advice}</td></tr>`);
  return html`<div class="card"><h2>Doctor</h2>
    <p role="status">${lacking.length ? `${lacking.length} of ${found.findings.length} checks failed.` : `All ${found.findings.length} checks passed.`}
      ${found.in_use ? " The instruments of this bench are in use by the panel and were not opened again. The Live page shows whether they answer." : ""}</p>
    <button type="button" onClick=${examine}>Check again</button>
    <table class="wide"><thead><tr><th scope="col">Kind</th><th scope="col">Name</th><th scope="col">Found</th><th scope="col">What to do</th></tr></thead>
      <tbody>${rows(lacking)}${rows(rest)}</tbody></table></div>`;
}
