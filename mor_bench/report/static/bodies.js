"use strict";
// Two views of deformed bodies that turn together.
Report.kinds.bodies = (figure, data) => {
  const R = Report;
  const found = data.bodies;
  const views = R.pair(figure);
  for (const view of views) {
    const caption = document.createElement("p");
    caption.className = "caption";
    view.before(caption);
  }
  const bytes = (text) => Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0)).buffer;
  const unpacked = ({ scale, data: text }) => Float32Array.from(new Int16Array(bytes(text)), (v) => v * scale);
  const points = unpacked(found.points);
  const facets = new Int32Array(bytes(found.facets));
  const edges = new Int32Array(bytes(found.edges));
  const n = points.length / 3;
  const kinds = [...new Set(found.samples.map((s) => s.kind))];
  const methods = R.options(data, kinds.includes("worst")
    ? found.samples.filter((s) => s.kind === "worst") : found.samples);
  const redraw = () => show();
  const ranks = { worst: "with the largest mean error e", middle: "with the median deformation, the same for all" };
  const kind = R.choice(figure, "test load", kinds.map((k) => [k, ranks[k]]), redraw);
  const chosen = [
    R.choice(figure, "left", methods, redraw), R.choice(figure, "right", methods, redraw),
  ];
  if (methods.length > 1) chosen[1].selectedIndex = 1;
  const factor = R.slider(figure, "deformation", [0, 2, 0.1, 1], redraw);
  const out = document.createElement("output");
  factor.after(out);
  const layers = {
    prediction: R.tick(figure, "prediction", true, redraw),
    reference: R.tick(figure, "reference", true, redraw),
    rest: R.tick(figure, "at rest", true, redraw),
  };
  const far = R.isNarrow() ? 1.75 : 1.2;
  const home = { eye: { x: 0.45 * far, y: -1.9 * far, z: 0.75 * far } };
  let camera = home;
  let turning = false;
  const SCALE = [[0, "#fff3d6"], [0.35, "#fdae61"], [0.7, "#d7301f"], [1, "#67000d"]];

  const corners = (() => {
    const i = [], j = [], k = [];
    for (let f = 0; f < facets.length; f += found.corners) {
      for (let c = 2; c < found.corners; c += 1) {
        i.push(facets[f]); j.push(facets[f + c - 1]); k.push(facets[f + c]);
      }
    }
    return { i, j, k };
  })();

  const column = (array, c) => Array.from({ length: n }, (_, i) => array[3 * i + c]);
  const xyz = (array) => ({ x: column(array, 0), y: column(array, 1), z: column(array, 2) });
  const moved = (u) => points.map((p, i) => p + Number(factor.value) * u[i]);

  function wire(array, name, colour, width) {
    const out = { x: [], y: [], z: [] };
    for (let e = 0; e < edges.length; e += 2) {
      for (const node of [edges[e], edges[e + 1]]) {
        out.x.push(array[3 * node]); out.y.push(array[3 * node + 1]); out.z.push(array[3 * node + 2]);
      }
      for (const key of ["x", "y", "z"]) out[key].push(null);
    }
    return { type: "scatter3d", mode: "lines", name, ...out, hoverinfo: "skip",
      line: { color: colour, width }, showlegend: false };
  }

  function arrow({ start, vector, moved: by, newton, pushes }) {
    const from = start.map((v, c) => v + Number(factor.value) * by[c]);
    const to = from.map((v, c) => v + vector[c]);
    const { ink } = R.theme();
    const head = { type: "cone", x: [to[0]], y: [to[1]], z: [to[2]], u: [vector[0]], v: [vector[1]],
      w: [vector[2]], anchor: "tip", showscale: false, sizemode: "absolute", hoverinfo: "skip",
      sizeref: 0.035 * found.size_m, colorscale: [[0, ink], [1, ink]] };
    const up = vector[2] > 0, place = (pushes ? !up : up) ? "top center" : "bottom center";
    const shaft = { type: "scatter3d", mode: "lines+text", showlegend: false, hoverinfo: "skip",
      x: [from[0], to[0]], y: [from[1], to[1]], z: [from[2], to[2]],
      text: pushes ? [`${R.short(newton)} N`, ""] : ["", `${R.short(newton)} N`],
      textposition: place, textfont: { color: ink, size: 12 },
      line: { color: ink, width: 5 } };
    return [shaft, head];
  }

  const sampleOf = (select) =>
    found.samples.find((s) => s.label === select.value && s.kind === kind.value);

  // The errors of all nodes, in mm.
  const sizes = (error) => Array.from({ length: n }, (_, i) =>
    1000 * Math.hypot(error[3 * i], error[3 * i + 1], error[3 * i + 2]));

  function traces(sample, largest) {
    const reference = unpacked(sample.reference);
    const error = unpacked(sample.error);
    const size = sizes(error);
    const { rest, reference: blue } = R.theme();
    const out = [];
    if (layers.rest.checked) out.push(wire(points, "at rest", rest, 1.5));
    if (layers.reference.checked) out.push(wire(moved(reference), "reference", blue, 2.5));
    if (layers.prediction.checked) {
      out.push({ type: "mesh3d", name: "prediction", ...xyz(moved(reference.map((v, i) => v + error[i]))),
        ...corners, intensity: size, colorscale: SCALE, cmin: 0, cmax: largest || 1, flatshading: true, hoverinfo: "text",
        lighting: { ambient: 0.75, diffuse: 0.5, specular: 0.05 },
        hovertext: size.map((v) => `error ${R.short(v)} mm`),
        colorbar: { title: { text: "error (mm)" }, thickness: 12, len: 0.8, tickformat: "~g" } });
    }
    return sample.force ? [...out, ...arrow(sample.force)] : out;
  }

  // One box around both bodies, with one scale for all axes of both views.
  function boxOf(all) {
    const keys = ["x", "y", "z"];
    const ranges = keys.map((key) => {
      const values = all.flatMap((trace) => trace[key] ?? []).filter((v) => v !== null);
      return [values.reduce((a, b) => Math.min(a, b)), values.reduce((a, b) => Math.max(a, b))];
    });
    const lengths = ranges.map(([low, high]) => Math.max(high - low, 1e-3 * found.size_m));
    const middle = Math.cbrt(lengths.reduce((a, b) => a * b));
    const axes = keys.map((key, i) => {
      const centre = (ranges[i][0] + ranges[i][1]) / 2;
      return [`${key}axis`, { visible: false, showspikes: false,
        range: [centre - lengths[i] / 2, centre + lengths[i] / 2] }];
    });
    return { ...Object.fromEntries(axes), aspectmode: "manual",
      aspectratio: Object.fromEntries(keys.map((key, i) => [key, lengths[i] / middle])) };
  }

  function one(view, select, drawn, box) {
    const sample = sampleOf(select);
    const text = sample ? sample.caption : "no finite prediction";
    view.previousElementSibling.textContent = `${R.nameOf(data, select.value)}: ${text}`;
    return R.draw(view, drawn, R.layout({
      height: R.isNarrow() ? 300 : 400, margin: { l: 0, r: 0, t: 8, b: 0 },
      scene: { ...box, camera, bgcolor: R.theme().paper },
    }));
  }

  function link(view, other) {
    const follow = (event) => {
      const turned = event["scene.camera"];
      if (!turned || turning) return;
      camera = turned;
      turning = true;
      Plotly.relayout(other, { "scene.camera": turned }).then(() => { turning = false; });
    };
    view.on("plotly_relayout", follow);
    view.on("plotly_relayouting", follow);
  }

  let linked = false;
  function show() {
    out.value = `× ${Number(factor.value).toFixed(1)}`;
    if (R.state.printing) return Promise.resolve();
    const left = sampleOf(chosen[0]);
    if (left) R.say(figure, `${R.nameOf(data, left.label)}, ${left.said}`);
    // One colour scale for both, so that equal colours are equal errors.
    const shown = chosen.map(sampleOf).filter(Boolean);
    const largest = Math.max(...shown.flatMap((s) => sizes(unpacked(s.error))));
    const drawn = chosen.map((select) => (sampleOf(select) ? traces(sampleOf(select), largest) : []));
    const box = shown.length ? boxOf(drawn.flat()) : {};
    return Promise.all(views.map((view, i) => one(view, chosen[i], drawn[i], box))).then(() => {
      if (linked) return;
      linked = true;
      link(views[0], views[1]);
      link(views[1], views[0]);
      views.forEach((view, i) => R.keyboard.scene(view, ["left view", "right view"][i], () => camera, home));
    });
  }
  return show;
};
