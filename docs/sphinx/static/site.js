// The theme's arrows of the navigation have no name: give each that of its section.
document.addEventListener("DOMContentLoaded", () => {
  for (const summary of document.querySelectorAll("nav summary, .bd-sidebar summary")) {
    const link = summary.closest("li")?.querySelector("a");
    summary.setAttribute("aria-label", `Pages of ${link?.textContent.trim() || "this section"}`);
  }
  // Sphinx sets the parameters of a long signature as a list of descriptions without terms.
  for (const list of document.querySelectorAll("dt.sig dl, dt.sig dl > dd")) {
    list.setAttribute("role", "none");
  }
});
