"""Objects of many frames, on which detection, tracking and motion are judged: rows, files, matching."""
