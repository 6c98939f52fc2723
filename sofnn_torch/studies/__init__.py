"""Studies over many seeds: what is run, the data, the tables and the figures."""
