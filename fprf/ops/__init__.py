"""Hot kernels: a plain torch reference, and faster back ends beside it."""
