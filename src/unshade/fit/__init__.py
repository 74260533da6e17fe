"""The numbers of a tree of a given structure: second order, BasinCMA, gradient; one file a fitter."""
