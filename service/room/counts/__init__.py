"""How far the counts of the stages are off, told by what the images show."""
