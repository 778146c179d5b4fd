// The token of this page, and answers by HTTP.
export const unsaved = new Set(); // why leaving or reloading the page asks first: what would be lost
addEventListener("beforeunload", (event) => { if (unsaved.size > 0) event.preventDefault(); });

export class Requests {
  constructor() {
    this.token = new URLSearchParams(location.search).get("token") || sessionStorage.getItem("token") || "";
    sessionStorage.setItem("token", this.token);
    history.replaceState(null, "", location.pathname + location.hash); // the token does not stay in the address
  }

  async request(name, values = {}) {
    try {
      const answer = await fetch(`/request/${name}`, {
        method: "POST", body: JSON.stringify(values),
        headers: { "Content-Type": "application/json", "X-Panel-Token": this.token },
      });
      return await answer.json();
    } catch {
      return { error: "The web server does not answer, or its answer is not valid. Look at the terminal in which haselab runs." };
    }
  }
}
