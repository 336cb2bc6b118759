import { Levels } from './levels.js';
import { SpatialViewer } from './spatial-viewer.js';

/** A level may take so much of the room for splats; where it does not fit, there is the preview alone. */
const LEVEL_SHARE = 1 / 2;

/** A viewer of scenes with levels: of each part of a scene it draws one of its versions. */
export class LevelViewer extends SpatialViewer {
  budgetOf(header) {
    const most = super.budgetOf(header);
    this.fits = header.level.count <= LEVEL_SHARE * most;
    return this.fits ? most - header.level.count : most;
  }

  beside({ preview, level }) {
    return new Levels(this, this.space, this.fits ? [preview, level] : [preview]);
  }

  nextPart() {
    const levels = this.spacePreview;
    const wanted = this.space.parts.some(({ inSight, place }) => inSight && !place);
    return levels.next() ?? (wanted ? super.nextPart() : null) ?? levels.next(true) ?? super.nextPart();
  }

  choose() {
    this.spacePreview?.choose();
  }
}
