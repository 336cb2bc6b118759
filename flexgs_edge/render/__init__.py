"""Render one view: project, sort and blend the splats of a scene, and sum what each Gaussian contributes."""
