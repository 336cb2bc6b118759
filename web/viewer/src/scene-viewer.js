import { SpatialViewer } from './spatial-viewer.js';

export const SceneViewer = SpatialViewer;
