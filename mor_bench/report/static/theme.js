"use strict";
// Shared state of the page: its data, the colours of the theme, and texts for plotly.
document.documentElement.classList.add("scripted");

const Report = (() => {
  const LIGHT = {
    ink: "#1f2328", quiet: "#57606a", paper: "#ffffff", grid: "#e3e6ea",
    need: "rgba(46,125,50,0.13)", needInk: "#1d5c1a", mesh: "rgba(120,120,120,0.13)",
    rest: "#a6a6a6", reference: "#2878b5", fitted: "#d98a29",
  };
  const DARK = {
    ink: "#e8eaed", quiet: "#a9b1ba", paper: "#161616", grid: "#33383d",
    need: "rgba(120,200,120,0.16)", needInk: "#a6dfa1", mesh: "rgba(190,190,190,0.13)",
    rest: "#6d6d6d", reference: "#7cc4ee", fitted: "#f0b35e",
  };
  const dark = window.matchMedia("(prefers-color-scheme: dark)");
  const state = { printing: false };
  const isDark = () => dark.matches && !state.printing;

  return {
    data: JSON.parse(document.getElementById("data").textContent),
    state,
    dark,
    kinds: {},
    theme: () => (isDark() ? DARK : LIGHT),
    textColourOf: (style) => (isDark() ? style.dark_text : style.text),
    colourOf: (style) => (isDark() ? style.dark_colour : style.colour),
    // Plotly reads some tags in texts; here every text stays text.
    plain: (text) => String(text).replace(/&/g, "&amp;").replace(/</g, "&lt;").replace(/>/g, "&gt;"),
  };
})();
