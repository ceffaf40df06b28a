"""The recursive estimators, live or over a bag: RLS and UKF as `init`, `step` and `fold`. What a
node runs; nothing here needs all the data at once."""
