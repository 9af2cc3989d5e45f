"""From a file to signals at a regular rate: formats, channel maps, checks, completion, the grid."""
