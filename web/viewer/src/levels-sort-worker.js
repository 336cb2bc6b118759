import { LevelSorter } from './level-sorter.js';
import { answer } from './sort-serve.js';

const sorter = new LevelSorter();

/** In also: { shown }. */
self.onmessage = ({ data }) => (data.shown ? sorter.show(data.shown) : answer(sorter, data));
