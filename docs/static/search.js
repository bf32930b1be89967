// How the site's search orders what it finds, and what it says about it. Sphinx copies it to the page of the search.
const SEARCHED = (new URLSearchParams(location.search).get("q") || "").toLowerCase();
const PAGES = Object.keys(SUMMARIES);

// Opened from a disk, a page cannot fetch others to quote them.
DOCUMENTATION_OPTIONS.SHOW_SEARCH_SUMMARY = location.protocol !== "file:";

const hasAll = (text, words) => words.length > 0 && words.every((word) => text.includes(` ${word}`));

var Scorer = {
  ...{ objNameMatch: 11, objPartialMatch: 6, objPrio: { 0: 15, 1: 5, 2: -5 }, objPrioDefault: 0 },
  ...{ title: 15, partialTitle: 7, term: 5, partialTerm: 2 },

  // All words searched for, in the title or in a page's line of "All pages", count more than one word of a heading.
  score(result) {
    const [name, title, , about, score] = result;
    if (about) return score;
    const stemmer = new Stemmer();
    const words = splitQuery(SEARCHED).filter((word) => !stopwords.has(word)).map((word) => stemmer.stemWord(word));
    const plain = (text) => ` ${splitQuery(text.toLowerCase()).join(" ")}`;
    const summary = SUMMARIES[name] || "";
    const place = PAGES.indexOf(name);
    const card = name.includes("/shipped/");
    if (card) result[1] = `Card: ${title}`;
    if (!DOCUMENTATION_OPTIONS.SHOW_SEARCH_SUMMARY) result[3] = summary;
    return (
      score +
      20 * hasAll(plain(title), words) +
      10 * hasAll(plain(`${name.split("/").pop()} ${summary}`), words) -
      (card || name.startsWith("docs/environments/") ? 12 : 0) -
      (place < 0 ? 8 : place / 10)
    );
  },
};
