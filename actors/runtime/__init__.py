"""What every actor is made of: loop, mailbox, timers, checkpoints, injected faults."""
