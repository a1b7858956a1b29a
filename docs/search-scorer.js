/* Scores of the search page, as Sphinx's own but for the last step: pages that say how to do something come before
   reference and explanation, and these before decisions and measurements. */
var Scorer = {
  score: function (result) {
    const page = result[0];
    const kinds = [["tutorial/", 3], ["how-to/", 3], ["reference/", 1.5], ["decisions/", 0.3]];
    const kind = kinds.find(([folder]) => page.startsWith(folder));
    return result[4] * (kind ? kind[1] : 1);
  },
  objNameMatch: 11,
  objPartialMatch: 6,
  objPrio: { 0: 15, 1: 5, 2: -5 },
  objPrioDefault: 0,
  title: 15,
  partialTitle: 7,
  term: 5,
  partialTerm: 2,
};
