"""Many sequences under many settings: jobs in parallel processes, cached results, tables, comparisons."""
