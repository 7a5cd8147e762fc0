// The panels, in the order of their tabs. A panel is {name, title, icon, place, mount(element, station) -> unmount};
// place: 'stage' (beside the dock), 'bar' (always visible) or 'dock', the default.
import { panel as console_ } from './console.js';
import { panel as images } from './images.js';
import { panel as nodes } from './nodes.js';
import { panel as parameters } from './parameters.js';
import { panel as plots } from './plots.js';
import { panel as recordings } from './recordings.js';
import { panel as steering } from './steering.js';
import { panel as topics } from './topics.js';
import { panel as vehicles } from './vehicles.js';

export const panels = [vehicles, plots, topics, console_, nodes, parameters, images, recordings, steering];
