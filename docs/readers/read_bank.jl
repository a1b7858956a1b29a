using HDF5
# green is (position, actuator, tap): Julia has HDF5's dimensions in reverse order.
read_bank(file) = h5open(file) do f
    reversed(name) = (a = read(f[name]); permutedims(a, ndims(a):-1:1))
    (green = reversed("green"),
     position_mm = reversed("position_mm"), actuator_mm = reversed("actuator_mm"),
     status = read(f["status"]), time_s = read(f["time_s"]),
     sample_rate_hz = read_attribute(f, "sample_rate_hz"),
     response_unit = read_attribute(f, "response_unit"))
end
