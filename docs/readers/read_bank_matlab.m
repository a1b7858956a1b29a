function bank = read_bank_matlab(file)
  % green is (position, actuator, tap): MATLAB has HDF5's dimensions in reverse order.
  bank.green = permute(h5read(file, '/green'), [3 2 1]);
  bank.position_mm = h5read(file, '/position_mm')';
  bank.actuator_mm = h5read(file, '/actuator_mm')';
  bank.status = h5read(file, '/status');
  bank.time_s = h5read(file, '/time_s');
  bank.sample_rate_hz = h5readatt(file, '/', 'sample_rate_hz');
  bank.response_unit = h5readatt(file, '/', 'response_unit');
end
