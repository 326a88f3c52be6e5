"use strict";
// The sortable table of configurations, and the dialog with all figures of one of them.
Report.table = (grid, data) => {
  const R = Report;
  const dialog = document.getElementById("details");

  function open(row) {
    const content = document.getElementById("details-content");
    document.getElementById("details-name").textContent = row.label;
    content.replaceChildren();
    for (const [group, figures] of row.details) {
      const heading = document.createElement("h3");
      const list = document.createElement("dl");
      heading.textContent = group;
      list.className = "facts";
      for (const [name, text] of figures) {
        const term = document.createElement("dt"), value = document.createElement("dd");
        term.textContent = name;
        value.textContent = text;
        list.append(term, value);
      }
      content.append(heading, list);
    }
    dialog.showModal();
  }

  function nameCell(cell) {
    const row = cell.getRow().getData();
    const button = document.createElement("button");
    button.type = "button";
    button.textContent = row.untested ? `${row.name} †` : row.name;
    button.addEventListener("click", () => open(row));
    return button;
  }

  const figureCell = (part) => (cell) => {
    const [value, span] = cell.getRow().getData().cells[part];
    const box = document.createElement("span");
    const small = document.createElement("small");
    small.textContent = span;
    box.append(value, small);
    return box;
  };
  // Texts with numbers inside, in the order of the numbers: r3 before r10, 1e-08 before 0.01.
  const parts = (text) => text.split(/(\d+(?:\.\d+)?(?:e[+-]?\d+)?)/);
  function natural(a, b) {
    const [one, two] = [parts(a), parts(b)];
    for (let i = 0; i < Math.min(one.length, two.length); i += 1) {
      const sign = i % 2 ? Number(one[i]) - Number(two[i]) : one[i].localeCompare(two[i]);
      if (sign) return sign;
    }
    return one.length - two.length;
  }
  const byMethod = (a, b, first, second) =>
    first.getData().method.localeCompare(second.getData().method) || natural(a, b);
  const textCell = (cell) => document.createTextNode(cell.getValue());
  const numbers = { sorter: "number", sorterParams: { alignEmptyValues: "bottom" }, hozAlign: "right" };

  const rows = data.order.map((label) => R.rowOf(data, label)).map((row, id) => ({
    ...row, id, error_value: row.error.median, latency_value: row.latency.median,
  }));
  const narrow = R.isNarrow(); // Name, error and latency fit a phone.
  const table = new Tabulator(grid, {
    data: rows,
    layout: "fitColumns",
    columnHeaderSortMulti: false,
    columns: [
      { title: "configuration", field: "name", formatter: nameCell, sorter: byMethod, minWidth: narrow ? 136 : 150, widthGrow: 2 },
      { title: "error (%)", field: "error_value", formatter: figureCell("error"), minWidth: narrow ? 114 : 126, ...numbers },
      { title: "latency (ms)", field: "latency_value", formatter: figureCell("latency"), minWidth: 112, ...numbers },
      { title: "offline (core\u2011s)", field: "offline", formatter: figureCell("offline"), minWidth: 96, ...numbers },
      { title: "told", field: "group", formatter: textCell, minWidth: narrow ? 200 : 150, widthGrow: 2 },
      { title: "qualifies", field: "answer", formatter: textCell, sorter: natural, minWidth: narrow ? 240 : 96, widthGrow: 2 },
    ],
    rowFormatter: (row) => {
      const { qualified, failed, status, front } = row.getData();
      const element = row.getElement();
      element.classList.toggle("meets", qualified);
      element.classList.toggle("bad", failed || status !== "ok");
      element.classList.toggle("front", front);
    },
  });
  table.on("tableBuilt", () => {
    grid.setAttribute("aria-label", `Configurations of ${data.dataset}`);
    // The buttons inside scroll by keyboard; a focusable box may not stand between grid and rows.
    const holder = grid.querySelector(".tabulator-tableholder");
    holder.removeAttribute("tabindex");
    holder.setAttribute("role", "presentation");
    // The headings sort by keyboard, too.
    for (const heading of grid.querySelectorAll(".tabulator-col.tabulator-sortable")) {
      heading.tabIndex = 0;
      heading.addEventListener("keydown", (event) => {
        if (event.key !== "Enter" && event.key !== " ") return;
        event.preventDefault();
        heading.click();
      });
    }
    filter();
  });

  const bar = document.createElement("div");
  bar.className = "controls";
  grid.before(bar);
  const figure = { querySelector: () => bar };
  const search = document.createElement("input");
  search.type = "search";
  const label = document.createElement("label");
  label.append("find ", search);
  bar.append(label);
  const only = R.tick(figure, "only those that qualify", false, filter);
  const status = document.createElement("p");
  status.setAttribute("role", "status");
  bar.after(status);
  table.on("dataFiltered", (_, found) => {
    status.textContent = found.length ? "" : "No configuration matches this search and these filters.";
  });
  search.addEventListener("input", filter);

  function filter() {
    const hidden = [...document.querySelectorAll(".filter input:not(:checked)")].map((i) => i.value);
    const wanted = search.value.toLowerCase();
    table.setFilter((row) =>
      !hidden.includes(row.told) && (!only.checked || row.qualified) &&
      `${row.label} ${row.name} ${row.group} ${row.answer}`.toLowerCase().includes(wanted));
  }
  document.querySelectorAll(".filter input").forEach((i) => i.addEventListener("change", filter));
  return table;
};
