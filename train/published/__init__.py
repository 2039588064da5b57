"""Published tables made again, cell by cell, and the page that they are read on (dissertation, tables 6.2 to 6.4).

What the tables hold is a list in `configs/published/` (plan). A cell is one scheduler on the instances of one scale
under one view, kept as a JSON file that is named by the hash of its inputs (cells). Filling plays the cells that
are not there yet (filling); everything else reads cells: figures (results), page (page) and picture.
"""
