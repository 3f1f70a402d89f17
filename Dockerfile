# docker build --target demo -t cartpole . && docker run --rm cartpole
# docker build --target test -t cartpole-test . && docker run --rm cartpole-test
FROM python:3.11-slim AS base
RUN apt-get update && apt-get install --yes --no-install-recommends g++ git make && rm -rf /var/lib/apt/lists/*
WORKDIR /cartpole_rl
COPY . .

FROM base AS demo
RUN scripts/install --cpu emulator
CMD ["scripts/demo"]

FROM base AS test
RUN apt-get update && apt-get install --yes --no-install-recommends chromium chromium-driver gcc-arm-none-eabi \
    libnewlib-arm-none-eabi python3-tk qemu-system-arm xvfb && rm -rf /var/lib/apt/lists/*
RUN scripts/install --cpu emulator,dev
CMD ["scripts/test"]
