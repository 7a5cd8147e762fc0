// The panels that rqt's plug-ins are elsewhere, and recordings, keyboard and gamepad, in the order of their tabs.
import { panel as console_ } from './console.js';
import { panel as images } from './images.js';
import { panel as nodes } from './nodes.js';
import { panel as parameters } from './parameters.js';
import { panel as plots } from './plots.js';
import { panel as recordings } from './recordings.js';
import { panel as steering } from './steering.js';
import { panel as topics } from './topics.js';

export const tools = [plots, images, recordings, steering, topics, console_, parameters, nodes];
