// Order of the search results: the option of a command that was typed, guides whose title has the
// word, guides whose text has it, then names of the API, then records of the project's history.
const typed = (new URLSearchParams(window.location.search).get("q") || "").trim().toLowerCase();
var Scorer = {
  score: ([page, title, anchor, about, score, file, kind]) => {
    const isHistory = /^(CHANGELOG|CONTRIBUTING|ARCHITECTURE|docs\/adr\/|docs\/project\/|benchmarks\/)/;
    const isStart = /^docs\/(start\/|concepts\/|hardware|control\/control)/;
    const isOption = typed.includes("-") && /^#cmdoption/.test(anchor);
    if (isOption && title.endsWith(`.--${typed.replace(/^-+/, "")}`)) return 60;
    if (kind === "object" || /^docs\/reference\/api/.test(page)) return score - 20;
    if (/(^|\/)(index|README)$/.test(page)) return score - 3;
    const aboutSafety = /safe|stop|shock|volt|arm|interlock|guardian|watchdog|trip/.test(typed);
    if (page === "docs/bench/safety") return score + (aboutSafety ? 8 : 0);
    return score + (isHistory.test(page) ? -10 : 0) + (isStart.test(page) ? 4 : 0);
  },
  objNameMatch: 11,
  objPartialMatch: 6,
  objPrio: {0: 15, 1: 5, 2: -5},
  objPrioDefault: 0,
  title: 15,
  partialTitle: 7,
  term: 5,
  partialTerm: 2,
};
