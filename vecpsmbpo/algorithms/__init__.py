"""One file per algorithm: init, act, observe, refresh and learn, written for one seed."""
