// The page Pick without a panel.
import { html, render } from "/static/vendor/htm-preact.js";
import Pick from "/static/pick.js";
import { Requests } from "/static/requests.js";

render(html`<header><h1>Pick points in a video</h1></header><main><${Pick} link=${new Requests()} /></main>`, document.getElementById("panel"));
