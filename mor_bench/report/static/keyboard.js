"use strict";
// Legends and 3D views by keyboard.
Report.keyboard = (() => {
  const HINT = "Enter hides or shows it, Shift+Enter shows it alone, arrow keys go to the others";

  // The library knows clicks only; a second click within its limit is a double-click.
  function click(toggle, times) {
    for (let i = 0; i < times; i += 1) {
      for (const type of ["mousedown", "mouseup"]) {
        toggle.dispatchEvent(new MouseEvent(type, { bubbles: true, cancelable: true, view: window }));
      }
    }
  }

  const BESIDE = { ArrowDown: 1, ArrowRight: 1, ArrowUp: -1, ArrowLeft: -1 };

  // A legend is one stop of the Tab key, however many entries it has.
  function decorate(plot) {
    const toggles = [...plot.querySelectorAll(".legend .traces .legendtoggle")];
    const stop = Math.min(Number(plot.dataset.entry || 0), toggles.length - 1);
    toggles.forEach((toggle, i) => {
      const entry = toggle.closest(".traces");
      const shown = Number(entry.style.opacity || 1) === 1;
      for (const [key, value] of Object.entries({
        tabindex: i === stop ? 0 : -1, role: "button", "aria-pressed": shown,
        "aria-label": `${entry.querySelector(".legendtext").textContent}: ${HINT}`,
      })) toggle.setAttribute(key, value);
    });
    return toggles;
  }

  function focus(plot, toggles, i) {
    plot.dataset.entry = (i + toggles.length) % toggles.length;
    decorate(plot)[plot.dataset.entry].focus();
  }

  function legend(plot) {
    if (plot.dataset.keys) return decorate(plot);
    plot.dataset.keys = "legend";
    plot.on("plotly_afterplot", () => decorate(plot));
    plot.addEventListener("keydown", (event) => {
      if (!event.target.matches(".legendtoggle")) return;
      const toggles = decorate(plot), i = toggles.indexOf(event.target);
      if (event.key === "Enter" || event.key === " ") click(event.target, event.shiftKey ? 2 : 1);
      else if (event.key in BESIDE) focus(plot, toggles, i + BESIDE[event.key]);
      else if (event.key === "Home" || event.key === "End") focus(plot, toggles, event.key === "Home" ? 0 : -1);
      else return;
      event.preventDefault();
    });
    decorate(plot);
  }

  // Turn by an angle around the vertical axis, lift by an angle, and come closer by a factor.
  function moved({ eye, ...others }, [turn, lift, closer]) {
    const far = Math.hypot(eye.x, eye.y, eye.z) / closer;
    const around = Math.atan2(eye.y, eye.x) + turn;
    const up = Math.min(1.5, Math.max(-1.5, Math.asin(eye.z / (far * closer)) + lift));
    const flat = far * Math.cos(up);
    return { ...others, eye: { x: flat * Math.cos(around), y: flat * Math.sin(around), z: far * Math.sin(up) } };
  }

  const STEPS = {
    ArrowLeft: [-0.15, 0, 1], ArrowRight: [0.15, 0, 1], ArrowUp: [0, 0.12, 1], ArrowDown: [0, -0.12, 1],
    "+": [0, 0, 1.15], "=": [0, 0, 1.15], "-": [0, 0, 1 / 1.15],
  };

  // `camera` returns the present camera, and `home` the first one.
  function scene(view, name, camera, home) {
    view.tabIndex = 0;
    view.setAttribute("role", "application");
    view.setAttribute("aria-label", `${name}: arrow keys turn, + and − zoom, Home resets`);
    view.addEventListener("keydown", (event) => {
      if (event.ctrlKey || event.metaKey || event.altKey) return;
      const step = STEPS[event.key];
      if (!step && event.key !== "Home") return;
      event.preventDefault();
      Plotly.relayout(view, { "scene.camera": step ? moved(camera(), step) : home });
    });
  }

  return { legend, scene };
})();
