// Charts come as JSON with the palette's names for colours; they are drawn anew when the screen
// turns dark or light.
(() => {
  const screen = matchMedia("(prefers-color-scheme: dark)");

  function colour(name) {
    const [variable, opacity] = name.slice(1).split(":");
    const hex = getComputedStyle(document.documentElement).getPropertyValue("--" + variable).trim();
    const [r, g, b] = [1, 3, 5].map((at) => parseInt(hex.slice(at, at + 2), 16));
    return `rgba(${r},${g},${b},${opacity ?? 1})`;
  }

  function coloured(value, key) {
    if (Array.isArray(value)) return value.map((item) => coloured(item, key));
    if (value && typeof value === "object")
      return Object.fromEntries(Object.entries(value).map(([k, v]) => [k, coloured(v, k)]));
    return typeof value === "string" && /color$/.test(key) && value[0] === "@" ? colour(value) : value;
  }

  const charts = [...document.querySelectorAll(".chart")].map((place) => {
    const data = place.querySelector("script");
    const chart = JSON.parse(data.textContent);
    data.remove();
    return [place, chart];
  });

  function draw() {
    for (const [place, chart] of charts) {
      const { data, layout } = coloured(chart, "");
      Plotly.react(place, data, layout, { displayModeBar: false, responsive: true });
    }
  }
  draw();
  screen.addEventListener("change", draw);
})();
