"""Green's functions between the positions of a grid coarser than half a wavelength.

===============  ====================================================================================
`waves`          waves of actuators and of sources along the rim; their wave number over frequency
`posterior`      `FrequencyWaves`: a Gaussian process of such waves at one frequency
`rim_waves`      `RimWaves`: the model of a whole bank: values, deviations, left-out errors
`left_out_rows`  `RowsByWaves`: each row predicted from all others, to be judged
===============  ====================================================================================
"""
