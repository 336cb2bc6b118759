"""`study paper`: repeats the experiments of the FlexGaussian paper on a user's scenes."""
