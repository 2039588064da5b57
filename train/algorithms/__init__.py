"""Learning algorithms, a module each: what estimates or supervises, and beside it the struct that configures it."""
