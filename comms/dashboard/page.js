"use strict";
const WINDOW = 96; // units of time that the timelines show
const SVG = "http://www.w3.org/2000/svg";
const at = (id) => document.getElementById(id);

function put(parent, name, text, kind) {
  const node = parent.appendChild(document.createElement(name));
  node.textContent = text;
  if (kind) node.className = kind;
  return node;
}

function bar(svg, from, to, colour, title) {
  const rect = svg.appendChild(document.createElementNS(SVG, "rect"));
  const shape = { x: from, y: 1, width: Math.max(to - from - 0.15, 0.3), height: 8, fill: colour };
  for (const [name, value] of Object.entries(shape)) rect.setAttribute(name, value);
  rect.appendChild(document.createElementNS(SVG, "title")).textContent = title;
}

function lane(cell, agent, state) {
  const svg = cell.appendChild(document.createElementNS(SVG, "svg"));
  svg.setAttribute("viewBox", `0 0 ${WINDOW} 10`);
  svg.setAttribute("preserveAspectRatio", "none");
  const first = Math.max(state.tick + 1 - WINDOW, 0);
  agent.lane.forEach(([tick, action, outcome], i) => {
    const next = i + 1 < agent.lane.length ? agent.lane[i + 1][0] : state.tick + 1;
    if (action === 0 || next < first) return;
    const kept = outcome === "decided";
    const colour = kept ? `hsl(${(action * 47) % 360} 60% 50%)` : "#b3261e";
    const title = `${state.unit} ${tick}: ${action}${kept ? "" : `, ${outcome}`}`;
    bar(svg, Math.max(tick, first) - first, (kept ? next : tick + 1) - first, colour, title);
  });
}

function show(state) {
  if (state.phase === "waiting") return;
  at("run").textContent = `run ${state.run}`;
  at("phase").textContent = state.phase;
  at("phase").className = `state ${state.phase}`;
  at("time").textContent = `${state.unit} ${state.tick} of ${state.horizon}`;
  at("progress").value = state.horizon ? state.tick / state.horizon : 0;
  at("lanes").textContent = `what it chose in the last ${WINDOW} ${state.unit}s`;
  const figures = at("figures");
  figures.replaceChildren();
  const shown = { decisions: state.decisions, "decisions per second": state.decisions_per_s, conflicts: state.conflicts };
  for (const [name, value] of Object.entries(state.objectives)) shown[name] = value.toFixed(4);
  for (const [name, value] of Object.entries(shown)) {
    const box = put(figures, "div", "");
    put(box, "b", value);
    put(box, "span", name);
  }
  const agents = at("agents");
  agents.replaceChildren();
  for (const agent of state.agents) {
    const row = put(agents, "tr", "");
    put(row, "td", agent.name);
    put(put(row, "td", ""), "span", agent.state, `state ${agent.state}`);
    for (const value of [agent.policy, agent.turns, agent.losses, `${agent.silent_s.toFixed(1)} s`]) put(row, "td", value);
    lane(put(row, "td", ""), agent, state);
  }
  const counts = Object.entries(state.counts).map(([kind, count]) => `${kind} ${count}`);
  at("counts").textContent = counts.join(", ") || "nothing unusual";
  const silent = state.silent_s > 2 ? `nothing heard of the world for ${state.silent_s.toFixed(0)} s; ` : "";
  at("error").textContent = silent + (state.last_error || "none");
}

if (location.hash === "#once") {
  fetch("state").then((answer) => answer.json()).then(show); // a still picture
} else {
  new EventSource("events").onmessage = (event) => show(JSON.parse(event.data));
}
