"""Files of other programs: PLY, SPZ, SOG, compressed PLY, model folders."""
