// Pictures over time become charts that are zoomed by dragging, set back by a double click and read
// under the pointer. Those with the same time axis move together. The drawn picture stays for
// printers, and where there is no pointer (telephones, screens without scripts).
"use strict";
{
  const resolved = (host, colour) => {
    host.style.color = colour;
    const found = getComputedStyle(host).color;
    host.style.color = "";
    return found;
  };
  const charts = [];

  const chart = (host, { x, y, title, label, lines, bands, spans }) => {
    const tables = [...lines.map((l) => [l.x, l.y]), ...bands.flatMap((b) => [[b.x, b.low], [b.x, b.high]])];
    const data = uPlot.join(tables);
    const ink = () => resolved(host, "currentColor");
    const faint = (colour, share) => `color-mix(in srgb, ${colour} ${100 * share}%, transparent)`;
    const stroke = ({ colour, alpha }) => () => faint(resolved(host, colour), alpha);
    const value = (u, v) => (v == null ? "–" : +v.toPrecision(4));
    const axis = { stroke: ink, grid: { stroke: () => faint(ink(), 0.12), width: 1 }, ticks: { show: false }, font: "11px system-ui" };
    const [first, last] = [data[0][0], data[0].at(-1)];
    let whole = true;   // not zoomed: with the limits of the drawn picture; uPlot asks for x first
    const width = (u, low, high) => {
      whole = low == null || (low <= Math.max(first, x[0]) && high >= Math.min(last, x[1]));
      return whole ? x : [Math.max(low, x[0]), Math.min(high, x[1])];
    };
    const edge = lines.length + 1;   // the first series of a band
    const options = {
      title, width: host.clientWidth, height: 230,
      cursor: { sync: { key: x.join(), scales: ["x", null] }, drag: { x: true, y: false } },
      scales: {
        x: { time: false, range: width },
        y: { range: (u, low, high) => (whole || low == null ? y : uPlot.rangeNum(low, high, 0.1, true)) },
      },
      axes: [
        { ...axis, size: 22, label: "time [s]", labelSize: 16, labelFont: "11px system-ui" },
        { ...axis, size: 52, label, labelSize: 16, labelFont: "11px system-ui" },
      ],
      series: [
        { label: "t", value: (u, v) => (v == null ? "–" : `${v.toFixed(2)} s`) },
        ...lines.map((l) => ({
          label: l.label, stroke: stroke(l), width: l.width, dash: l.dash, value, points: { show: l.marked, size: 4 },
          ...(l.step ? { paths: uPlot.paths.stepped({ align: 1 }) } : {}),
        })),
        ...bands.flatMap(() => [0, 1].map(() => ({ label: "", class: "edge", points: { show: false } }))),
      ],
      bands: bands.map((b, i) => ({ series: [edge + 2 * i + 1, edge + 2 * i], fill: stroke(b) })),
      hooks: {
        drawClear: [(u) => {
          u.ctx.fillStyle = faint(ink(), 0.1);
          for (const [from, to] of spans) {
            const left = Math.max(u.valToPos(from, "x", true), u.bbox.left);
            const right = Math.min(u.valToPos(to, "x", true), u.bbox.left + u.bbox.width);
            if (right > left) u.ctx.fillRect(left, u.bbox.top, right - left, u.bbox.height);
          }
        }],
      },
    };
    charts.push([new uPlot(options, data, host), host]);
  };

  if (!matchMedia("(pointer: coarse)").matches) {
    for (const script of document.querySelectorAll("script.curves")) {
      const place = script.parentElement;
      place.classList.add("live");
      for (const one of JSON.parse(script.textContent)) {
        const host = place.appendChild(document.createElement("div"));
        chart(host, one);
      }
    }
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => charts.forEach(([c]) => c.redraw()));
    addEventListener("resize", () => charts.forEach(([c, host]) => c.setSize({ width: host.clientWidth, height: c.height })));
  }
}
