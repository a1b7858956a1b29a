function bank = read_bank_octave(file)
  % green is (position, actuator, tap): Octave has HDF5's dimensions in reverse order.
  pkg load netcdf
  bank.green = permute(ncread(file, 'green'), [3 2 1]);
  bank.position_mm = ncread(file, 'position_mm')';
  bank.actuator_mm = ncread(file, 'actuator_mm')';
  bank.status = ncread(file, 'status');
  bank.time_s = ncread(file, 'time_s');
  bank.sample_rate_hz = ncreadatt(file, '/', 'sample_rate_hz');
end
