"""Read and write files of other programs: PLY, SPZ, SOG, compressed PLY, model folders."""
