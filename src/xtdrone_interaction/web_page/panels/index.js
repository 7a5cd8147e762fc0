// The panels, in the order of their tabs. A panel is {name, title, icon, place, mount(element, station) -> unmount};
// place: 'stage' (beside the dock), 'bar' (always visible) or 'dock', the default.
import { panel as map } from './map.js';
import { panel as scene } from './scene.js';
import { panel as swarm } from './swarm_commands.js';
import { panel as time } from './time.js';
import { tools } from './tools.js';
import { panel as vehicles } from './vehicle_table.js';

export const panels = [time, scene, map, vehicles, swarm, ...tools];
