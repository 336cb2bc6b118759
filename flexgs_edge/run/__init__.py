"""Code that all commands share: options, inputs, the plan, the render context, the evaluators."""
