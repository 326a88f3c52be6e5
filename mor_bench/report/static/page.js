"use strict";
// Start: tables at once, charts when they come into view or are printed.
(() => {
  const R = Report;
  const charts = [...document.querySelectorAll(".chart")].map((figure) => {
    const data = R.data[Number(figure.dataset.index)];
    return { figure, show: R.kinds[figure.dataset.chart](figure, data), shown: false };
  });
  const show = (chart) => { chart.shown = true; return chart.show(); };

  const seen = new IntersectionObserver((entries) => {
    for (const entry of entries.filter((e) => e.isIntersecting)) {
      const chart = charts.find((c) => c.figure === entry.target);
      seen.unobserve(entry.target);
      if (!chart.shown) show(chart);
    }
  }, { rootMargin: "400px" });
  charts.forEach((chart) => seen.observe(chart.figure));

  for (const grid of document.querySelectorAll(".grid")) {
    const data = R.data[Number(grid.dataset.index)];
    if (data.rows.length) R.table(grid, data);
  }

  const again = () => charts.filter((c) => c.shown).forEach(show);
  R.dark.addEventListener("change", again);
  let width = window.innerWidth;
  window.addEventListener("resize", () => {
    const crossed = width < 700 !== window.innerWidth < 700;
    width = window.innerWidth;
    if (crossed) again();
  });

  let opened = [];
  window.addEventListener("beforeprint", () => {
    R.state.printing = true;
    charts.forEach(show);
    opened = [...document.querySelectorAll("main details:not([open])")];
    for (const details of opened) details.open = true;
  });
  window.addEventListener("afterprint", () => {
    R.state.printing = false;
    for (const details of opened) details.open = false;
    again();
  });

  // A link into a folded part opens it. Charts above it take their room first, or it would move away.
  const unfold = async () => {
    const part = document.getElementById(window.location.hash.slice(1));
    if (!part) return;
    const folded = part.closest("details");
    if (folded) folded.open = true;
    const above = charts.filter(({ figure, shown }) =>
      !shown && figure.compareDocumentPosition(part) & Node.DOCUMENT_POSITION_FOLLOWING);
    await Promise.all(above.map(show));
    part.scrollIntoView();
  };
  window.addEventListener("hashchange", unfold);
  unfold();

  for (const button of document.querySelectorAll("button.copy")) {
    button.addEventListener("click", async () => {
      const command = button.parentElement.nextElementSibling;
      try {
        await navigator.clipboard.writeText(command.textContent);
        button.textContent = "copied";
      } catch {
        window.getSelection().selectAllChildren(command);
      }
    });
  }
})();
