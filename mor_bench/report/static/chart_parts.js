"use strict";
// Parts that all charts share: layout, axes, controls, drawing when visible.
Object.assign(Report, (() => {
  const CONFIG = { displayModeBar: false, responsive: true, showTips: false };
  const PRINT_WIDTH = 680;

  const isNarrow = () => window.innerWidth < 700 || Report.state.printing;

  function axis(title, more = {}) {
    const { ink, grid } = Report.theme();
    return {
      title: { text: title, standoff: 8, font: { size: isNarrow() ? 12 : 14 } }, gridcolor: grid, linecolor: ink, zeroline: false,
      automargin: true, tickformat: "~g", color: ink, ...(isNarrow() ? { nticks: 5 } : {}), ...more,
    };
  }

  // Between powers of ten there is no room for numbers on a phone, unless the axis is short.
  function logAxis(title, more = {}) {
    const [low, high] = more.range ?? [0, 0];
    const decades = isNarrow() && Math.floor(high) > Math.ceil(low) ? { dtick: 1 } : {};
    return axis(title, { type: "log", ...decades, ...more });
  }

  function layout(more = {}) {
    const { ink, paper } = Report.theme();
    return {
      paper_bgcolor: paper, plot_bgcolor: paper, hovermode: "closest",
      font: { color: ink, size: 13, family: 'system-ui, "DejaVu Sans", sans-serif' },
      margin: { l: 58, r: 12, t: 24, b: 48 },
      hoverlabel: { align: "left", bgcolor: paper, bordercolor: ink, font: { color: ink, size: 13 } },
      ...(Report.state.printing ? { width: PRINT_WIDTH, autosize: false } : { autosize: true }),
      ...more,
    };
  }

  // A legend beside the chart, or below it where there is no room; `entries` give its height.
  function legend(entries, height) {
    if (!isNarrow()) return { height, legend: { x: 1.02, y: 1, font: { size: 12 }, tracegroupgap: 6 } };
    const below = 21 * entries + 30;
    return {
      height: height + below,
      legend: { x: 0, y: -64 / (height - 64), yanchor: "top", font: { size: 12 }, tracegroupgap: 4 },
      margin: { l: 58, r: 12, t: 24, b: 60 + below },
    };
  }

  function draw(plot, traces, its) {
    const drawn = Plotly.react(plot, traces, its, CONFIG);
    plot.dataset.drawn = "yes";
    Report.keyboard.legend(plot);
    return drawn;
  }

  function labelled(figure, text, element) {
    const label = document.createElement("label");
    label.append(`${text} `, element);
    figure.querySelector(".controls").append(label);
    return element;
  }

  // `options` are pairs of value and text; `changed` is called after each choice.
  function choice(figure, text, options, changed) {
    const select = document.createElement("select");
    for (const [value, shown] of options) select.append(new Option(shown, value));
    select.addEventListener("change", changed);
    return labelled(figure, text, select);
  }

  function slider(figure, text, range, changed) {
    const input = document.createElement("input");
    Object.assign(input, { type: "range", min: range[0], max: range[1], step: range[2] });
    input.value = range[3];
    input.addEventListener("input", changed);
    return labelled(figure, text, input);
  }

  function tick(figure, text, checked, changed) {
    const input = document.createElement("input");
    Object.assign(input, { type: "checkbox", checked });
    input.addEventListener("change", changed);
    return labelled(figure, text, input);
  }

  // State what a chart shows now, in its caption and for screen readers.
  function say(figure, finding) {
    const heading = figure.querySelector("h3").textContent;
    figure.querySelector(".finding").textContent = `${finding}.`;
    figure.querySelector(".plot").setAttribute("aria-label", `${heading}: ${finding}.`);
  }

  const rowOf = (data, label) => data.rows.find((row) => row.label === label);
  const styleOf = (data, row) => data.styles[row.method];
  const colour = (data, label) => {
    const row = rowOf(data, label);
    return row ? Report.colourOf(styleOf(data, row)) : Report.theme().ink;
  };
  // Darker or lighter than the marks, so that small letters have enough contrast.
  const textColour = (data, label) => {
    const row = rowOf(data, label);
    return row ? Report.textColourOf(styleOf(data, row)) : Report.theme().ink;
  };
  const symbol = (data, label) => {
    const row = rowOf(data, label);
    return row ? styleOf(data, row).symbol : "circle";
  };
  const nameOf = (data, label) => rowOf(data, label)?.name ?? label;
  const hover = (lines) => lines.map(Report.plain).join("<br>");
  // The line of the winner's method, or the first one.
  const winnerOf = (data, lines) => lines.find(
    (line) => rowOf(data, line.label).method === rowOf(data, data.winner)?.method,
  ) ?? lines[0];
  const options = (data, lines) => {
    const labels = lines.map((line) => line.label), first = winnerOf(data, lines)?.label;
    const ordered = labels.length ? [first, ...labels.filter((l) => l !== first)] : [];
    return ordered.map((label) => [label, nameOf(data, label)]);
  };
  // Few significant digits, as in the tables.
  const short = (value) => (value === null ? "–" : Number(value.toPrecision(3)).toString());

  return {
    axis, logAxis, layout, legend, draw, choice, slider, tick, rowOf, styleOf, colour, textColour, symbol,
    nameOf, hover, options, short, isNarrow, say, winnerOf,
  };
})());
