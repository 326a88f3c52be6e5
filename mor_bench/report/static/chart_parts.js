"use strict";
// Parts that all charts share: layout, axes, controls, drawing when visible.
Object.assign(Report, (() => {
  const CONFIG = { displayModeBar: false, responsive: true, showTips: false };
  const PRINT_WIDTH = 680;
  const FONT = 'system-ui, "DejaVu Sans", sans-serif';

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
    // Between 1 and 10, labels at 2 and 5 have room; all nine would cover each other.
    const few = high - low > 4 ? 1 : "D2";
    const decades = isNarrow() && Math.floor(high) > Math.ceil(low) ? { dtick: 1 }
      : high - low > 0.9 ? { dtick: few } : {};
    return axis(title, { type: "log", ...decades, ...more });
  }

  // Counts such as 10k and 1M: powers of ten only where they span more than three decades.
  function countAxis(title, [low, high]) {
    const step = Math.max(1, Math.ceil((high - low) / (isNarrow() ? 5 : 10)));
    const decades = high - low > 3 || isNarrow() ? { dtick: step } : {};
    return axis(title, { type: "log", range: [low, high], tickformat: "~s", ...decades });
  }

  const PEN = document.createElement("canvas").getContext("2d");
  // Width of a text in pixels.
  function widthOf(text, size) {
    PEN.font = `${size}px ${FONT}`;
    return PEN.measureText(text).width;
  }

  function layout(more = {}) {
    const { ink, paper } = Report.theme();
    return {
      paper_bgcolor: paper, plot_bgcolor: paper, hovermode: "closest",
      font: { color: ink, size: 13, family: FONT },
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
  const dash = (data, label) => {
    const row = rowOf(data, label);
    return row ? styleOf(data, row).dash : "solid";
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
  // Few significant digits; the same text as `number` makes for the tables.
  function short(value) {
    if (value === null) return "–";
    const size = Math.abs(value);
    if (size === 0 || (size >= 1e-3 && size < 99.95)) return Number(value.toPrecision(3)).toString();
    if (size >= 1 && size < 1e5) return value.toFixed(0);
    return value.toExponential(1).replace(/([+-])(\d)$/, (_, sign, digit) => `${sign}0${digit}`);
  }

  return {
    axis, logAxis, countAxis, widthOf, layout, legend, draw, choice, slider, tick, rowOf, styleOf, colour, textColour, symbol, dash,
    nameOf, hover, options, short, isNarrow, say, winnerOf,
  };
})());
