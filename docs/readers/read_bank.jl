using HDF5

# green is (position, actuator, tap): Julia has the dimensions of HDF5 in reverse order.
read_bank(file) = h5open(file) do f
    (green = permutedims(read(f["green"]), (3, 2, 1)),
     position_mm = permutedims(read(f["position_mm"])), actuator_mm = permutedims(read(f["actuator_mm"])),
     status = read(f["status"]), time_s = read(f["time_s"]),
     sample_rate_hz = read_attribute(f, "sample_rate_hz"), response_unit = read_attribute(f, "response_unit"))
end
