"""One run of one cell: prepare, claim its folder, train, evaluate, write its rows."""
