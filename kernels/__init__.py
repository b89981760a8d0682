"""Warp kernels, one file per physical effect; imported as ``warpjelly.kernels`` and importing nothing of the package.

Every quantity of the particles is one array ``[3, particle_count]`` of float32 or float64 (structure of arrays), read
and written in kernels through the accessors of ``vectors``. Kernels are generic over the precision: the arrays decide.
"""
