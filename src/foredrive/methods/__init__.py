"""Published methods, a folder each: configuration, network, loss, training and recipes."""
