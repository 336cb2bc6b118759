"""`study paper`: the tables and figures of FlexGaussian."""
