"""Code that all commands share: options, inputs, the plan, the renderer, the evaluators."""
