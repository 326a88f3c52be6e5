"use strict";
// The chart of error against latency or work.
Report.kinds.frontier = (figure, data) => {
  const R = Report;
  const plot = figure.querySelector(".plot");
  // Much smaller errors than needed are of no use, and would compress the scale.
  const needed = data.rows.filter((r) => !r.reference && r.error.median > 0).map((r) => r.error.median);
  let FLOOR = Math.max(1e-4, Math.min(...needed, data.needs.error ?? Infinity) / 10);
  const near = data.rows.map((r) => r.error.median).filter((value) => value >= FLOOR / 3);
  FLOOR = Math.min(FLOOR, ...near); // A value slightly below stands in its place.
  const EDGE = FLOOR / 2; // Smaller errors stand here, apart from all others.
  const TOP = 200; // Larger errors are of no use; one outlier would stretch the axis.
  const redraw = () => show();
  const error = R.choice(figure, "error", [
    ["median", "median"], ["p95", "95th percentile"], ["max", "maximum"],
  ], redraw);
  const time = R.choice(figure, "against", [
    ["median", "latency, median"], ["p95", "latency, 95th percentile"], ["max", "latency, maximum"],
    ["work", "work: multiply-adds"],
  ], redraw);

  const x = (row) => (time.value === "work" ? row.work : row.latency[time.value]);
  const y = (row) => row.error[error.value];
  const inside = (value) => (value < FLOOR ? EDGE : Math.min(value, TOP));
  let hidden = new Set(); // methods that the legend hides
  let size = [500, 450]; // of the plot in pixels; after drawing, the real one

  function shownRows() {
    const filtered = [...document.querySelectorAll(".filter input:not(:checked)")].map((i) => i.value);
    return data.rows.filter(
      (row) => x(row) > 0 && y(row) !== null && y(row) >= 0 && !filtered.includes(row.told),
    );
  }

  function bars(rows, part, value) {
    const spans = rows.map((row) => row[part].span);
    const end = (i, sign) => rows.map((row, n) => {
      const limit = spans[n] && spans[n][i];
      const known = limit !== null && limit !== undefined && y(row) === inside(y(row));
      return !known ? 0 : Math.max(0, sign * (limit - value(row)));
    });
    return {
      type: "data", symmetric: false, array: end(1, 1), arrayminus: end(0, -1), thickness: 1, width: 0,
    };
  }

  // Place of a row in pixels, from the lower left corner of the plot.
  const at = (value, [low, high], length) => (length * (Math.log10(value) - low)) / (high - low);
  const pixels = (row, range) => [at(x(row), range.x, size[0]), at(inside(y(row)), range.y, size[1])];
  // A box around a centre, and whether two of them overlap.
  const boxAt = ([px, py], width, height) => [px - width / 2, py - height / 2, px + width / 2, py + height / 2];
  const overlap = (a, b) => a[0] < b[2] && b[0] < a[2] && a[1] < b[3] && b[1] < a[3];

  // Labels of the front that do not cover each other or a text in `taken`, which grows by them.
  function labelled(rows, range, taken) {
    const found = new Set();
    for (const row of rows.filter((r) => r.front && y(r) === inside(y(r)))) {
      const [px, py] = pixels(row, range), width = R.widthOf(labelOf(row), 12);
      const box = [px + 3, py + 1, px + width + 12, py + 24];
      if (taken.some((other) => overlap(box, other))) continue;
      taken.push(box);
      found.add(row);
    }
    return found;
  }

  // On a phone names have no room: the front and the winner get numbers, which a list explains.
  const AROUND = [1, 1.7, 2.5, 3.4].flatMap((far) => [
    [13, 12], [-13, 12], [13, -12], [-13, -12], [0, 18], [0, -18], [19, 0], [-19, 0],
  ].map(([dx, dy]) => [far * dx, far * dy]));
  const list = document.createElement("ol");
  list.className = "numbers";
  list.hidden = true;
  list.setAttribute("aria-label", "Numbers in the chart: the Pareto front and the winner");
  plot.after(list);

  const listed = (rows) => rows.filter((row) => row.front || row.label === data.winner)
    .sort((a, b) => x(a) - x(b) || y(a) - y(b));

  function numbers(front, rows, range, taken) {
    const markers = rows.map((row) => boxAt(pixels(row, range), 12, 12));
    return front.flatMap((row, i) => {
      if (y(row) !== inside(y(row))) return [];
      const [px, py] = pixels(row, range), text = String(i + 1), width = R.widthOf(text, 13) + 8;
      const places = AROUND.map(([dx, dy]) => {
        const box = boxAt([px + dx, py + dy], width, 18);
        return { dx, dy, box, covered: markers.filter((marker) => overlap(box, marker)).length };
      }).filter(({ box }) => box[0] >= 0 && box[1] >= 0 && box[2] <= size[0] && box[3] <= size[1]
        && !taken.some((other) => overlap(box, other)));
      if (!places.length) return [];
      const best = places.reduce((a, b) => (b.covered < a.covered ? b : a));
      taken.push(best.box);
      return [{
        x: Math.log10(x(row)), y: Math.log10(y(row)), ax: best.dx, ay: -best.dy, text,
        arrowhead: 0, arrowwidth: 1, standoff: 6, arrowcolor: R.theme().quiet,
        bgcolor: R.theme().paper, borderpad: 0,
        font: { size: 13, color: R.textColourOf(R.styleOf(data, row)) },
      }];
    });
  }

  function explain(front) {
    const unit = time.value === "work" ? "multiply-adds" : "ms";
    list.hidden = !front.length;
    list.replaceChildren(...front.map((row) => {
      const item = document.createElement("li"), name = document.createElement("b");
      name.textContent = row.name;
      name.style.color = R.textColourOf(R.styleOf(data, row));
      item.append(name, `: ${R.short(y(row))}\u00a0%, ${R.short(x(row))}\u00a0${unit}`,
        row.label === data.winner ? " (winner)" : "");
      return item;
    }));
  }

  // What is plotted comes first; the medians follow if they are not what is plotted.
  function hoverOf(row) {
    const [name, medianError, medianLatency, ...rest] = row.hover;
    const [shownError, shownTime] = [error, time].map((select) => select.selectedOptions[0].text);
    const plotted = [
      error.value === "median" ? medianError : `error, ${shownError}: ${R.short(y(row))} %`,
      time.value === "median" ? medianLatency
        : time.value === "work" ? `work: ${R.short(x(row))} multiply-adds` : `${shownTime}: ${R.short(x(row))} ms`,
    ];
    const medians = [
      ...(error.value === "median" ? [] : [`median ${medianError}`]),
      ...(time.value === "median" ? [] : [`median ${medianLatency}`]),
    ];
    return R.hover([name, ...plotted, ...medians, ...rest]);
  }

  const FRONT = "Pareto front";
  // A method's name in the legend; a dagger marks those that are not tested where they are built for.
  const entryOf = (row) => R.plain(row.untested ? `${row.method} †` : row.method);
  const labelOf = (row) => row.name.split(" · ")[1] ?? row.name;

  // One line of a method; the first of them stands for all in the legend.
  function trace(rows, group, named, number) {
    const style = R.styleOf(data, rows[0]);
    const colour = R.colourOf(style);
    const medians = error.value === "median" && time.value === "median";
    const open = (row) => (row.unstable ? "-open" : "");
    return {
      type: "scatter", mode: "lines+markers+text", name: entryOf(rows[0]),
      legendgroup: R.plain(group), legendgrouptitle: { text: R.plain(group), font: { size: 12 } },
      x: rows.map(x), y: rows.map((row) => inside(y(row))),
      text: rows.map((row) => (named.has(row) ? R.plain(labelOf(row)) : "")),
      textposition: "top right", textfont: { color: R.textColourOf(style), size: 12 },
      hovertext: rows.map(hoverOf), hoverinfo: "text",
      visible: hidden.has(entryOf(rows[0])) ? "legendonly" : true,
      line: { color: colour, width: 1, dash: data.dashes[number % data.dashes.length] }, showlegend: number === 0,
      marker: {
        color: colour, size: 10, line: { color: colour, width: 1.5 },
        symbol: rows.map((row) => style.symbol + open(row)),
      },
      error_x: medians ? { ...bars(rows, "latency", x), color: colour } : undefined,
      error_y: medians ? { ...bars(rows, "error", (row) => inside(y(row))), color: colour } : undefined,
    };
  }

  function steps(rows) {
    const sorted = [...rows].sort((a, b) => x(a) - x(b) || y(a) - y(b));
    const best = [];
    for (const row of sorted) {
      if (y(row) < 100 && (!best.length || y(row) < y(best.at(-1)))) best.push(row);
    }
    return {
      type: "scatter", mode: "lines", name: FRONT, x: best.map(x),
      visible: hidden.has(FRONT) ? "legendonly" : true,
      y: best.map((row) => inside(y(row))), hoverinfo: "skip",
      line: { shape: "hv", dash: "dash", width: 1.5, color: R.theme().ink },
    };
  }

  function marks(range) {
    const { need, needInk, mesh, ink } = R.theme();
    const shapes = [], annotations = [];
    const write = (text, at, more) => annotations.push({
      text, x: at[0], y: at[1], showarrow: false, font: { size: 12, color: ink }, ...more,
    });
    const low = [10 ** range.x[0], 10 ** range.y[0]];
    if (error.value === "median" && data.mesh_error > low[1]) {
      const top = Math.min(data.mesh_error, 10 ** range.y[1]);
      shapes.push({ type: "rect", xref: "paper", x0: 0, x1: 1, y0: low[1], y1: top,
        fillcolor: mesh, line: { width: 0 }, layer: "below" });
      write(`grey: below the mesh’s own error (${data.mesh_at_least ? "at least " : ""}${R.short(data.mesh_error)} %)`, [0, 1],
        { xref: "paper", yref: "paper", xanchor: "left", yanchor: "bottom" });
    }
    if (error.value === "median" && time.value === "median" && data.needs.error && data.needs.latency) {
      shapes.push({ type: "rect", x0: low[0], x1: data.needs.latency, y0: low[1], y1: data.needs.error,
        fillcolor: need, line: { color: needInk, width: 1 }, layer: "below" });
      write(`needed: ≤ ${R.short(data.needs.error)} %, ≤ ${R.short(data.needs.latency)} ms`,
        [range.x[0], range.y[0]],
        { xanchor: "left", yanchor: "bottom", font: { size: 12, color: needInk } });
    }
    return { shapes, annotations };
  }

  // Places of the centre of a label beside its marker, the nearest first.
  const AWAY = [26, 42, 58, 74, 90, 106, 122, 138];
  const BESIDE = [0, 0.5, -0.5, 1, -1];

  // Small boxes along the arrow from a label's centre to its marker, outside the label.
  const arrowOf = ([px, py], [lx, ly]) => [0.3, 0.4, 0.5, 0.6, 0.7, 0.8].map(
    (part) => boxAt([lx + part * (px - lx), ly + part * (py - ly)], 4, 4),
  );

  // Values beyond the axis stand at its edge, with an arrow and the value. Such a label and its arrow
  // cover no text or arrow in `taken`, and markers only where there is no other place; without a
  // place it is left out.
  function cuts(rows, range, taken, front) {
    const cut = rows.filter((row) => y(row) > TOP || y(row) < FLOOR);
    const markers = rows.map((row) => boxAt(pixels(row, range), 12, 12));
    // The way of each arrow, which the labels of the others leave free if they can.
    const ways = cut.map((row) => {
      const [px, py] = pixels(row, range);
      return boxAt([px, py - (y(row) > TOP ? 1 : -1) * 26], 12, 40);
    });
    return cut.flatMap((row, number) => {
      const avoided = [...markers, ...ways.filter((_, other) => other !== number)];
      const value = `${R.short(y(row))} %`;
      const text = !R.isNarrow() ? `${row.name}: ${value}`
        : front.includes(row) ? `${front.indexOf(row) + 1}: ${value}` : value;
      const side = y(row) > TOP ? 1 : -1, [px, py] = pixels(row, range), width = R.widthOf(text, 11) + 6;
      const places = AWAY.flatMap((away) => BESIDE.map((part) => {
        const shift = part * width;
        const centre = [px + shift, py - side * away], box = boxAt(centre, width, 19);
        const arrow = arrowOf([px, py], centre);
        return { shift, away, box, arrow, covered: avoided.filter((other) => overlap(box, other)).length };
      })).filter(({ box, arrow }) => box[0] >= 0 && box[1] >= 0 && box[2] <= size[0] && box[3] <= size[1]
        && !taken.some((other) => overlap(box, other) || arrow.some((part) => overlap(part, other))));
      if (!places.length) return [];
      const best = places.reduce((a, b) => (b.covered < a.covered ? b : a));
      taken.push(best.box, ...best.arrow);
      return [{
        x: Math.log10(x(row)), y: Math.log10(inside(y(row))), ax: best.shift, ay: side * best.away,
        text: R.plain(text),
        bgcolor: R.theme().paper, arrowhead: 2, standoff: 6,
        font: { size: 11, color: R.theme().ink }, arrowcolor: R.theme().quiet,
      }];
    });
  }

  function rangeOf(values, extra) {
    const logs = [...values, ...extra].filter((v) => v > 0 && Number.isFinite(v)).map(Math.log10);
    const margin = 0.06 * (Math.max(...logs) - Math.min(...logs)) + 0.12;
    return [Math.min(...logs) - margin, Math.max(...logs) + margin];
  }

  // The verdict's title holds for medians of all classes; other choices have their own finding.
  const verdict = figure.querySelector(".finding").textContent.replace(/\.$/, "");
  function finding(rows) {
    if (error.selectedIndex === 0 && time.selectedIndex === 0 && rows.length === all.length) return verdict;
    const [needed, named] = [data.needs.error, error.selectedOptions[0].text];
    const able = rows.filter((row) => !row.failed && (!needed || y(row) <= needed));
    const within = needed ? ` with an error (${named}) of at most ${R.short(needed)} %` : "";
    if (!able.length) return `No configuration shown has an error (${named}) of at most ${R.short(needed)} %`;
    const best = able.reduce((a, b) => (x(b) < x(a) ? b : a));
    const cost = time.value === "work" ? "does the least work" : `is the fastest (${time.selectedOptions[0].text})`;
    return `${best.name} ${cost} of those shown${within}: ${R.short(y(best))} % ` +
      (time.value === "work" ? `for ${R.short(x(best))} multiply-adds` : `in ${R.short(x(best))} ms`);
  }
  const all = shownRows();

  function show() {
    const rows = shownRows();
    const visible = rows.filter((row) => !hidden.has(entryOf(row)));
    R.say(figure, finding(visible));
    const wanted = time.value === "work" || error.value !== "median" ? [] : [data.needs.latency];
    const range = {
      x: rangeOf(rows.map(x), wanted),
      y: rangeOf(rows.map((row) => inside(y(row))), [data.needs.error]),
    };
    const { shapes, annotations } = marks(range);
    const taken = annotations.filter((note) => note.yref !== "paper")
      .map((note) => [0, 0, R.widthOf(note.text, 12) + 6, 19]);
    const front = R.isNarrow() ? listed(visible) : [];
    const traces = [], named = R.isNarrow() ? new Set() : labelled(visible, range, taken);
    const counted = numbers(front, visible, range, taken);
    explain(front);
    for (const group of data.groups) {
      const mine = rows.filter((row) => row.group === group);
      for (const method of new Set(mine.map((row) => row.method))) {
        const lines = data.lines
          .map((labels) => mine.filter((row) => row.method === method && labels.includes(row.label)))
          .filter((members) => members.length);
        traces.push(...lines.map((members, number) => trace(members, group, named, number)));
      }
    }
    traces.push(steps(rows));
    const title = time.value === "work" ? "multiply-adds of one query"
      : `latency of one query, ${time.selectedOptions[0].text.split(", ")[1]} (ms)`;
    const its = R.layout({
      xaxis: time.value === "work" ? R.countAxis(title, range.x) : R.logAxis(title, { range: range.x }),
      yaxis: R.logAxis(`relative L2 error, ${error.selectedOptions[0].text} (%)`, { range: range.y }),
      shapes, annotations: [...annotations, ...counted, ...cuts(visible, range, taken, front)],
      ...R.legend(traces.filter((t) => t.showlegend !== false).length + data.groups.length, R.isNarrow() ? 400 : Math.min(560, Math.max(400, window.innerHeight - 280))),
    });
    its.legend.groupclick = "toggleitem";
    const drawn = R.draw(plot, traces, its);
    follow();
    return drawn;
  }

  // Labels follow the legend, and the real size of the plot.
  let following = false;
  function follow() {
    if (following) return;
    following = true;
    plot.on("plotly_restyle", () => {
      hidden = new Set(plot.data.filter((t) => t.visible === "legendonly" && t.showlegend !== false)
        .map((t) => t.name));
      show();
    });
    plot.on("plotly_afterplot", fit);
    fit();
  }
  function fit() {
    const { xaxis, yaxis } = plot._fullLayout;
    const now = [xaxis._length, yaxis._length];
    if (now.every((length, i) => Math.abs(length - size[i]) < 4)) return;
    size = now;
    show();
  }

  document.querySelectorAll(".filter input").forEach((i) => i.addEventListener("change", redraw));
  return show;
};
