// Table of the vehicles.
import { html, render } from '../vendor/preact_htm.js';
import { COLUMNS } from '../fleet.js';

const number = (value, digits = 1) => (Number.isFinite(value) ? value.toFixed(digits) : '–');

function mount(element, station) {
  const draw = () => {
    const rows = station.roster.vehicles.map(({ name }, i) => {
      const row = station.fleet?.vehicles.subarray(i * COLUMNS, (i + 1) * COLUMNS) ?? [];
      return html`<tr key=${name} data-vehicle=${name} class=${station.selection.has(name) ? 'selected' : ''}
          onclick=${() => station.selection.toggle(name)}>
        <td>${name}</td><td class="num">${number(row[2])}</td><td class="num">${number(Math.hypot(row[7], row[8], row[9]))}</td></tr>`;
    });
    render(html`<table><thead><tr><th>vehicle</th><th class="num">height m</th><th class="num">speed m/s</th></tr></thead>
      <tbody>${rows}</tbody></table>`, element);
  };
  const timer = setInterval(draw, 250);
  const off = station.selection.onChange(draw);
  draw();
  return () => { clearInterval(timer); off(); render(null, element); };
}

export const panel = { name: 'vehicles', title: 'Vehicles', icon: '☰', mount };
