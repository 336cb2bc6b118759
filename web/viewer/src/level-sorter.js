import { Sorter } from './sort.js';

/** Sorts those of its lists of rows that are shown. */
export class LevelSorter extends Sorter {
  constructor() {
    super();
    this.all = new Map();
  }

  add(means, importance, start) {
    this.all.set(start, [means, importance, start]);
    if (this.parts.some((part) => part.start === start)) super.add(means, importance, start);
  }

  /** Show the lists that begin at these rows, and no others. */
  show(starts) {
    const wanted = new Set(starts);
    this.parts = this.parts.filter(({ start }) => wanted.has(start));
    for (const { start } of this.parts) wanted.delete(start);
    for (const start of wanted) super.add(...this.all.get(start));
  }
}
