"""Code that all commands share: options, inputs, the plan, the bench, the judges."""
