"""Jobs on a Dask cluster: the client that hands them out, and what a worker does with one."""
