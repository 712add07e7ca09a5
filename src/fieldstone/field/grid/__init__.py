"""The field of dense feature grids: layout, decoder, marching, one step; kernels beside their references."""
