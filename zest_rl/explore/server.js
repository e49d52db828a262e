// Questions to the server, and where their failures are told.

import { $ } from "./elements.js";

// A body is a file or what becomes JSON.
export async function ask(path, body) {
  const request = body === undefined ? {} : { method: "POST", body, headers: { "content-type": body.type } };
  if (body !== undefined && !(body instanceof Blob))
    Object.assign(request, { body: JSON.stringify(body), headers: { "content-type": "application/json" } });
  const response = await fetch(path, request);
  const answer = await response.json().catch(() => ({ error: "the server does not answer as it should" }));
  if (!response.ok) throw new Error(answer.error);
  return answer;
}

export function tell(error) {
  $("#problem").textContent = error.message;
  $("#problem").hidden = false;
}

// Does what the user asked for; what was told before is not about this.
export async function attempt(work) {
  $("#problem").hidden = true;
  await work().catch(tell);
}
