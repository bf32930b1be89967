// How the search orders what it finds. Sphinx copies this to the page of the search, which has SUMMARIES: what the lists
// of pages say of each page, in their order; and the WORDS that the glossary explains.
const PAGES = Object.keys(SUMMARIES);
const wordsOf = (text) => splitQuery(text.toLowerCase().replaceAll("_", " "));
const SEARCHED = wordsOf(new URLSearchParams(location.search).get("q") || "");
const STEMMER = new Stemmer();

// Opened from a disk, a page cannot fetch others to quote them: it shows their summaries.
DOCUMENTATION_OPTIONS.SHOW_SEARCH_SUMMARY = location.protocol !== "file:";

function hasAll(text) {
  const words = SEARCHED.filter((word) => !stopwords.has(word));
  const begins = (start) => text.includes(` ${start}`);
  return words.length > 0 && words.every((word) => begins(word) || begins(STEMMER.stemWord(word)));
}

var Scorer = {
  ...{ objNameMatch: 11, objPartialMatch: 6, objPrio: { 0: 5, 1: 0, 2: -5 }, objPrioDefault: 0 },
  ...{ title: 15, partialTitle: 7, term: 5, partialTerm: 2 },

  score(result) {
    const [page, title, anchor, about, score] = result;
    if (about) return score - 12 * /^Python (attribute|property|method)/.test(about);
    const summary = SUMMARIES[page] || "";
    const card = page.includes("/shipped/");
    if (card) result[1] = `Card: ${title}`;
    if (!DOCUMENTATION_OPTIONS.SHOW_SEARCH_SUMMARY) result[3] = summary;
    const named = ` ${wordsOf(`${title} ${page.split("/").pop()}`).join(" ")}`;
    const place = PAGES.indexOf(page);
    return (
      score +
      (anchor ? 10 : 20) * hasAll(named) +
      15 * (!anchor && named.includes(` ${SEARCHED.join(" ")}`)) +
      15 * hasAll(` ${wordsOf(summary).join(" ")}`) +
      12 * (page === "docs/glossary" && WORDS.includes(SEARCHED.join(" "))) -
      12 * (card || /^docs.environments.(?!README)/.test(page)) -
      (place < 0 ? 12 : place / 5)
    );
  },
};
