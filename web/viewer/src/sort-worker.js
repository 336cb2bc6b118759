import { Sorter } from './sort.js';
import { answer } from './sort-serve.js';

const sorter = new Sorter();
self.onmessage = ({ data }) => answer(sorter, data);
