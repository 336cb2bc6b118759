import { LevelViewer } from './level-viewer.js';

export const SceneViewer = LevelViewer;
