import { Viewer } from './viewer.js';

export const SceneViewer = Viewer;
