% What many labs do by hand, for one log: delay, settling time and energy cost.
% octave --no-gui docs/migrate.m LOG.csv STIFFNESS STEP MASS DELAY
arguments = argv();
data = dlmread(arguments{1}, ',', 0, 0);
numbers = cellfun(@str2double, arguments(2:end));
stiffness = numbers(1); step = numbers(2); mass = numbers(3); delay = numbers(4);
data = data(any(data, 2) | (1:rows(data))' == rows(data), :);
time = data(:, 1); command = data(:, 2); position = data(:, 3);
T = median(diff(time));

edge = find(abs(command) > 0.5 * abs(step), 1);       % the step, here by its size
start = edge + delay;                                 % the first d samples are dropped (6.1.4)
x = position(start:end) - position(1);
final = step / stiffness;                             % (6.1), not the last sample
outside = find(abs(x - final) > 0.02 * abs(final));
settling = 0; if any(outside), settling = outside(end); end

velocity = [0; diff(x)] / T;
energy = 0.5 * stiffness * (x - final).^2 + 0.5 * mass * velocity.^2;
weight = (0:numel(x) - 1)';
cost = sum(weight .* energy) / (step^2 / (2 * stiffness));
printf('{"settle_2pct": %d, "energy_step_w1": %.6f, "overshoot": %.6f}\n', settling, cost, max(x) / final - 1);
