"use strict";
// The plain charts: distributions, deformations, positions, costs, singular values, trainings.
Report.kinds.distributions = (figure, data) => {
  const R = Report;
  const plot = figure.querySelector(".plot");
  const kind = R.choice(figure, "show", [["error", "error"], ["latency", "latency"]], () => show());
  function finding() {
    const lines = data.distributions.filter((line) => line[kind.value].x.length);
    const line = R.winnerOf(data, lines), row = R.rowOf(data, line.label);
    const { p95, max } = row[kind.value], name = R.nameOf(data, line.label);
    return kind.value === "error"
      ? `${name}: 95 % of the test loads have a relative L2 error below ${R.short(p95)} %, the largest is ${R.short(max)} %`
      : `${name}: 95 % of the queries take less than ${R.short(p95)} ms, the slowest ${R.short(max)} ms`;
  }
  function show() {
    const traces = data.distributions.filter((line) => line[kind.value].x.length).map((line) => ({
      type: "scatter", mode: "lines", name: R.plain(R.nameOf(data, line.label)),
      x: line[kind.value].x, y: line[kind.value].share.map((s) => 100 * s),
      line: { color: R.colour(data, line.label), shape: "hv", width: 2,
        dash: R.dash(data, line.label) },
      hovertemplate: `%{y:.3~g} % of ${kind.value === "error" ? "the loads" : "the queries"}: ` +
        `at most %{x:.3~g} ${kind.value === "error" ? "%" : "ms"}`,
    }));
    R.say(figure, finding());
    const all = data.distributions.map((line) => line[kind.value]).filter((line) => line.x.length);
    const at = (line, share) => line.x[Math.max(0, line.share.findIndex((s) => s >= share))];
    const low = Math.min(...all.map((line) => at(line, 0.01)).filter((v) => v > 0));
    const high = 1.5 * Math.max(...all.map((line) => at(line, 0.99)));
    const unit = kind.value === "error" ? "%" : "ms";
    const beyond = data.distributions.filter((line) => line[kind.value].x.at(-1) > high);
    const named = kind.value === "error" ? "relative L2 error (%)" : "latency of one query (ms)";
    const limit = data.needs[kind.value];
    const lines = limit ? [{ type: "line", x0: limit, x1: limit, yref: "paper", y0: 0, y1: 1,
      line: { color: R.theme().needInk, dash: "dot", width: 1.5 } }] : [];
    const notes = limit ? [{ x: Math.log10(limit), xanchor: "left", y: 0.02, yref: "paper",
      yanchor: "bottom", text: "needed", showarrow: false, font: { color: R.theme().needInk } }] : [];
    return R.draw(plot, traces, R.layout({
      xaxis: R.logAxis(named, all.length ? { range: [Math.log10(low), Math.log10(high)] } : {}),
      yaxis: R.axis("share (%)", { range: [0, 102] }), shapes: lines,
      annotations: [...notes, ...beyond.map((line, i) => ({
        xref: "paper", x: 0.995, xanchor: "right", y: 12 + 7 * i, showarrow: false,
        font: { size: 12, color: R.textColour(data, line.label) },
        text: R.plain(`${R.nameOf(data, line.label)}: up to ${R.short(line[kind.value].x.at(-1))} ${unit} →`),
      }))], ...R.legend(traces.length, 400),
    }));
  }
  return show;
};

Report.kinds.deformations = (figure, data) => {
  const R = Report;
  const plot = figure.querySelector(".plot");
  const dots = R.choice(figure, "dots of", R.options(data, data.deformations), () => show());
  const kind = R.choice(figure, "error", [["mm", "e (mm)"], ["%", "relative L2 error (%)"]], () => show());
  function show() {
    const unit = kind.value, named = unit === "mm" ? "error e" : "relative L2 error";
    const dotsOf = (l) => (unit === "mm" ? l.y : l.share);
    const mediansOf = (l) => (unit === "mm" ? l.median_y : l.median_share);
    const traces = data.deformations.map((line) => ({
      type: "scatter", mode: "lines+markers", name: R.plain(R.nameOf(data, line.label)),
      x: line.median_x, y: mediansOf(line),
      line: { color: R.colour(data, line.label), width: 1.5 },
      marker: { symbol: R.symbol(data, line.label), size: 7, color: R.colour(data, line.label) },
      hovertemplate: `median ${named} %{y:.3~g} ${unit} at %{x:.3~g} mm`,
    }));
    const line = data.deformations.find((l) => l.label === dots.value);
    const [least, most] = [mediansOf(line)[0], mediansOf(line).at(-1)].map(R.short);
    R.say(figure, `${R.nameOf(data, line.label)}: the median ${named} is ${least} ${unit} at the smallest ` +
      `deformations and ${most} ${unit} at the largest`);
    traces.unshift({
      type: "scatter", mode: "markers", name: "test loads", x: line.x, y: dotsOf(line), showlegend: false,
      marker: { color: R.colour(data, line.label), size: 5, opacity: 0.35 },
      hovertemplate: `${named} %{y:.3~g} ${unit} at %{x:.3~g} mm<extra></extra>`,
    });
    const medians = data.deformations.flatMap(mediansOf).filter((v) => v > 0);
    const top = Math.max(...medians, ...dotsOf(line));
    const range = [Math.log10(Math.min(...medians)) - 0.5, Math.log10(top) + 0.2];
    return R.draw(plot, traces, R.layout({
      xaxis: R.axis("largest displacement (mm)"),
      yaxis: R.logAxis(`${named} (${unit})`, { range }), ...R.legend(traces.length, 420),
    }));
  }
  return show;
};

Report.kinds.positions = (figure, data) => {
  const R = Report;
  const plot = figure.querySelector(".plot");
  const found = data.positions;
  const maps = found.maps.filter((map) => map.error.some((e) => e > 0));
  const method = R.choice(figure, "method", R.options(data, maps), () => show());
  function show() {
    const map = maps.find((m) => m.label === method.value);
    const edges = { x: [], y: [] };
    for (let i = 0; i < found.edges.length; i += 4) {
      edges.x.push(found.edges[i], found.edges[i + 2], null);
      edges.y.push(found.edges[i + 1], found.edges[i + 3], null);
    }
    const known = found.x.map((_, i) => i).filter((i) => map.error[i] > 0);
    const other = found.x.map((_, i) => i).filter((i) => !(map.error[i] > 0));
    const logs = known.map((i) => Math.log10(map.error[i]));
    const [low, high] = [Math.min(...logs), Math.max(...logs)];
    const worst = known.reduce((a, b) => (map.error[b] > map.error[a] ? b : a));
    R.say(figure, `${R.nameOf(data, map.label)}: median relative L2 error ${R.short(10 ** low)} to ${R.short(10 ** high)} %, ` +
      `largest where the load acts around (${found.centres[worst].join(", ")}) m`);
    const ticks = [0, 0.25, 0.5, 0.75, 1].map((t) => low + t * (high - low));
    const at = (i) => `(${found.centres[i].join(", ")}) m`;
    const traces = [
      { type: "scatter", mode: "lines", ...edges, hoverinfo: "skip", line: { color: R.theme().quiet, width: 1 } },
      { type: "scatter", mode: "markers", x: other.map((i) => found.x[i]), y: other.map((i) => found.y[i]),
        marker: { symbol: "circle-open", size: 8, color: R.theme().quiet },
        hovertext: other.map((i) => `no test load at ${at(i)}`), hoverinfo: "text" },
      { type: "scatter", mode: "markers", x: known.map((i) => found.x[i]), y: known.map((i) => found.y[i]),
        hovertext: known.map((i) => `${R.short(map.error[i])} % at ${at(i)}`), hoverinfo: "text",
        marker: {
          size: found.x.length > 400 ? 8 : 15, color: logs, colorscale: "Viridis", reversescale: true,
          line: { color: R.theme().ink, width: 0.5 }, cmin: low, cmax: high,
          colorbar: { title: { text: "error (%)" }, tickvals: ticks, thickness: 14,
            ticktext: ticks.map((t) => R.short(10 ** t)) },
        } },
    ];
    const bare = { visible: false, zeroline: false };
    return R.draw(plot, traces, R.layout({
      xaxis: bare, yaxis: { ...bare, scaleanchor: "x" }, showlegend: false,
      height: R.isNarrow() ? 320 : 430, margin: { l: 8, r: 8, t: 8, b: 8 },
    }));
  }
  return show;
};

Report.kinds.singular = (figure, data) => {
  const R = Report;
  const plot = figure.querySelector(".plot");
  const { sigma, tail } = data.singular;
  return function show() {
    const { quiet, ink } = R.theme();
    const count = sigma.map((_, i) => i + 1);
    const line = (name, y, colour, width) => ({ type: "scatter", mode: "lines", name, y,
      x: count.slice(0, y.length), line: { color: colour, width },
      hovertemplate: `%{x}: %{y:.3~g}` });
    const traces = [
      line("singular value / largest", sigma, quiet, 1.5),
      line("tail: left out by r modes", tail, ink, 2.5),
    ];
    for (const { method, ranks } of data.ranks) {
      const shown = ranks.filter((r) => r <= tail.length);
      const style = data.styles[method];
      traces.push({ type: "scatter", mode: "markers", name: R.plain(method), x: shown,
        y: shown.map((r) => tail[r - 1]),
        marker: { symbol: style.symbol, size: 11, color: R.colourOf(style) },
        hovertemplate: "r = %{x}: %{y:.3~g}" });
    }
    // Modes far beyond those that were tried say nothing; a drag shows them.
    const tried = data.ranks.flatMap(({ ranks }) => ranks.map((r) => tail[r - 1])).filter((t) => t > 0);
    const floor = Math.max((tried.length ? Math.min(...tried) : Math.min(...tail)) / 30, 1e-12);
    const beyond = tail.findIndex((t) => t < floor);
    const last = beyond > 0 ? beyond : sigma.length;
    return R.draw(plot, traces, R.layout({
      xaxis: R.logAxis("number of modes r", { range: [-0.06, Math.log10(last) + 0.06], ...(R.isNarrow() ? {} : { dtick: "D2" }) }),
      yaxis: R.logAxis("relative to all snapshots", { range: [Math.log10(floor), 0.1] }),
      ...R.legend(traces.length, 400),
    }));
  };
};

Report.kinds.learning = (figure, data) => {
  const R = Report;
  const plot = figure.querySelector(".plot");
  return function show() {
    const traces = data.learning.map(({ method, label, points }) => ({
      type: "scatter", mode: "lines+markers", name: R.plain(R.nameOf(data, label)),
      x: points.map((p) => p[0]), y: points.map((p) => p[1]),
      line: { color: data.styles[method] ? R.colourOf(data.styles[method]) : R.theme().ink },
      marker: { size: 9, symbol: data.styles[method]?.symbol },
      hovertemplate: "%{x} samples: %{y:.3~g} %",
    }));
    const sizes = [...new Set(data.learning.flatMap((line) => line.points.map((p) => p[0])))];
    return R.draw(plot, traces, R.layout({
      xaxis: R.logAxis("training samples", { tickvals: sizes, ticktext: sizes.map(String) }),
      yaxis: R.logAxis("relative L2 error, median (%)"), ...R.legend(traces.length, 400),
    }));
  };
};

Report.kinds.losses = (figure, data) => {
  const R = Report;
  const plot = figure.querySelector(".plot");
  return function show() {
    const traces = data.losses.flatMap((line) => [["loss", "solid"], ["validation", "dash"]]
      .filter(([key]) => line[key]).map(([key, dash]) => ({
        type: "scatter", mode: "lines", x: line[key].map((_, i) => (100 * (i + 1)) / line[key].length),
        y: line[key], name: R.plain(R.nameOf(data, line.label)) + (key === "loss" ? "" : ", held out"),
        line: { color: R.colour(data, line.label), dash, width: 1.5 },
        hovertemplate: "%{y:.3~g} after %{x:.0f} %",
      })));
    return R.draw(plot, traces, R.layout({
      xaxis: R.axis("part of the training (%)"), yaxis: R.logAxis("loss"),
      ...R.legend(traces.length, 380),
    }));
  };
};

Report.kinds.costs = (figure, data) => {
  const R = Report;
  const { lines, full_order: fullOrder } = data.costs;
  const [left, right] = R.pair(figure);
  const pays = lines.map((l) => l.break_even).filter((q) => q > 0);
  const first = Math.log10(data.costs.queries);
  const number = R.slider(figure, "number of queries", [0, 9, 1, first], () => parts());

  const out = document.createElement("output");
  number.after(out);
  const scale = R.choice(figure, "bars in", [["seconds", "core-seconds"], ["shares", "shares of the total (%)"]], () => parts());
  const total = (line, n) => line.data + line.fit + n * line.query;

  function totals() {
    const top = Math.max(7, ...pays.map((q) => Math.log10(q) + 1));
    const counts = Array.from({ length: 41 }, (_, i) => 10 ** ((top * i) / 40));
    const traces = lines.map((line) => ({
      type: "scatter", mode: "lines", name: R.plain(R.nameOf(data, line.label)), x: counts,
      y: counts.map((n) => total(line, n)), legendgroup: R.plain(line.label),
      line: { color: R.colour(data, line.label), width: line.label === fullOrder ? 3 : 1.8,
        dash: R.dash(data, line.label) },
      hovertemplate: "%{y:.3~g} core-s for %{x:.2~g} queries",
    }));
    for (const line of lines.filter((l) => l.break_even > 0)) {
      traces.push({ type: "scatter", mode: "markers", showlegend: false, legendgroup: R.plain(line.label),
        x: [line.break_even], y: [total(line, line.break_even)],
        marker: { symbol: "diamond", size: 11, color: R.colour(data, line.label),
          line: { color: R.theme().ink, width: 1 } },
        hovertext: [R.hover([R.nameOf(data, line.label), `pays off after ${line.break_even} queries`])],
        hoverinfo: "text" });
    }
    return R.draw(left, traces, R.layout({
      xaxis: R.countAxis("number of queries", [0, top]),
      yaxis: R.logAxis("core-seconds"), height: 440,
      legend: { orientation: "h", y: -0.2, font: { size: 12 } },
    }));
  }

  function parts() {
    const n = 10 ** Number(number.value), shares = scale.value === "shares";
    const count = n.toLocaleString("en-US");
    out.value = count;
    const named = lines.map((line) => R.plain(R.nameOf(data, line.label)));
    const sums = lines.map((line) => total(line, n)).sort((a, b) => a - b);
    // One costly method must not hide the others: the axis ends, and the bar gets its value.
    const end = shares ? 100 : 1.15 * Math.min(sums.at(-1), 4 * sums[Math.floor((sums.length - 1) / 2)]);
    const { ink, paper, fitted, reference, rest } = R.theme();
    // The library has no bars: wide lines from the end of one part to the end of the next.
    const begun = lines.map(() => 0);
    const part = (name, value, colour) => {
      const [x, y, hovertext] = [[], [], []];
      lines.forEach((line, i) => {
        const from = begun[i], share = (100 * value(line)) / total(line, n);
        begun[i] += shares ? share : value(line);
        x.push(from, begun[i], null);
        y.push(named[i], named[i], null);
        const text = R.hover([R.nameOf(data, line.label),
          `${name}: ${R.short(value(line))} core-s, ${R.short(share)} % of ${R.short(total(line, n))}`]);
        hovertext.push(text, text, "");
      });
      return { type: "scatter", mode: "lines", name, x, y, hovertext, hoverinfo: "text",
        line: { width: 22, color: colour } };
    };
    const note = (line, more) => ({ y: R.plain(R.nameOf(data, line.label)), showarrow: false,
      bgcolor: paper, font: { size: 12, color: ink }, ...more });
    const notes = shares
      ? lines.map((line) => note(line, { x: 101, xanchor: "left", text: `${R.short(total(line, n))} core-s` }))
      : lines.filter((line) => total(line, n) > end).map((line) =>
        note(line, { x: end, xanchor: "right", text: `${R.short(total(line, n))} →` }));
    const axis = shares
      ? R.axis("share of the total (%)", { range: [0, R.isNarrow() ? 150 : 125], tickvals: [0, 25, 50, 75, 100] })
      : R.axis("core-seconds", { range: [0, end] });
    return R.draw(right, [
      part("training data", (l) => l.data, reference),
      part("fit", (l) => l.fit, fitted),
      part(`${count} queries`, (l) => n * l.query, rest),
    ], R.layout({
      height: 440, xaxis: axis,
      yaxis: R.axis("", { range: [lines.length - 0.4, -0.6], type: "category", tickformat: "" }), annotations: notes,
      legend: { orientation: "h", y: -0.2, font: { size: 12 } },
    }));
  }
  return () => Promise.all([totals(), parts()]);
};

// Two plots beside each other in one figure.
Report.pair = (figure) => {
  const plot = figure.querySelector(".plot");
  plot.classList.add("pair");
  return [0, 1].map(() => {
    const box = document.createElement("div");
    box.append(document.createElement("div"));
    plot.append(box);
    return box.firstChild;
  });
};
