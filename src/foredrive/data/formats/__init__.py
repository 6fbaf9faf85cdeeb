"""Raw data: readers of data sets, bags and folders that become 123D logs."""
