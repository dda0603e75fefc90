"""What work may take: threads, processes of their own for what strangers wrote, memory, places in the queue."""
