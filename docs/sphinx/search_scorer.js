// Order of the search results: guides whose title has the word, guides whose text has it, then names
// of the API, then records of the project's history.
var Scorer = {
  score: ([page, title, anchor, about, score, file, kind]) => {
    const isHistory = /^(CHANGELOG|CONTRIBUTING|ARCHITECTURE|docs\/adr\/|docs\/project\/|benchmarks\/)/;
    const isStart = /^docs\/(start\/|concepts\/|hardware|control\/control)/;
    if (kind === "object" || /^docs\/reference\/api/.test(page)) return score - 20;
    if (/(^|\/)(index|README)$/.test(page)) return score - 3;
    if (page === "docs/bench/safety") return score + 6;
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
