import { PreviewViewer } from './preview-viewer.js';

export const SceneViewer = PreviewViewer;
